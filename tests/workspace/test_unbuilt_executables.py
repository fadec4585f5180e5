"""A checkout of a workspace runs as it is: its executables, modules and launch files."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from rsltrace import Trace
from rsltrace.adapters.workspace.imports import unbuilt_packages
from rsltrace.adapters.workspace.installs import executables, modules
from rsltrace.errors import JobError
from rsltrace.run.plans.executables import find_executable, why_not_runnable
from rsltrace.source_packages import SourcePackage, workspaces_of

Command = Callable[..., subprocess.CompletedProcess[str]]

_PACKAGE = "<package format='3'><name>{}</name></package>"
_SETUP = """
import os
from glob import glob
from setuptools import find_packages, setup
open('setup_was_run', 'w')
setup(
    name='talker_py', packages=find_packages(exclude=['test']),
    data_files=[(os.path.join('share', 'talker_py', 'settings'), glob('config/*.yaml'))],
    entry_points={'console_scripts': ['talker = talker_py.talker:main']},
)
"""
_TALKER = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import String
from tools_cmake.helper import word

class Talker(Node):
    def __init__(self):
        super().__init__('talker')
        self.declare_parameter('rate', 1.0)
        self.publisher = self.create_publisher(String, 'said', 10)
        self.create_timer(1 / self.get_parameter('rate').value, self.tick)

    def tick(self):
        self.publisher.publish(String(data=word()))

def main(args=None):
    rclpy.init(args=args)
    rclpy.spin(Talker())
"""
_RELAY = """#!/usr/bin/env python3
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node('relay')
publisher = node.create_publisher(String, 'heard', 10)
node.create_subscription(String, 'said', publisher.publish, 10)
rclpy.spin(node)
"""
_CMAKE = """
project(tools_cmake)  # what follows is plain
ament_python_install_package(${PROJECT_NAME} PACKAGE_DIR python/tools_cmake)
install(PROGRAMS scripts/relay.py DESTINATION lib/${PROJECT_NAME} RENAME relay)
install(PROGRAMS scripts/relay.py DESTINATION bin)
install(FILES README.md DESTINATION share/${PROJECT_NAME})
"""
_LAUNCH = """
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch_ros.actions import Node

def generate_launch_description():
    share = get_package_share_directory('talker_py')
    return LaunchDescription([
        Node(package='talker_py', executable='talker', parameters=[share + '/settings/p.yaml']),
        IncludeLaunchDescription(AnyLaunchDescriptionSource(share + '/launch/relay.launch.xml')),
    ])
"""
_FILES = {
    "src/talker_py/package.xml": _PACKAGE.format("talker_py"),
    "src/talker_py/setup.py": _SETUP,
    "src/talker_py/talker_py/__init__.py": "",
    "src/talker_py/talker_py/talker.py": _TALKER,
    "src/talker_py/config/p.yaml": "talker: {ros__parameters: {rate: 4.0}}\n",
    "src/talker_py/launch/all.launch.py": _LAUNCH,
    "src/talker_py/launch/relay.launch.xml": (
        "<launch><let name='share' value='$(find-pkg-share tools_cmake)'/>"
        "<node pkg='tools_cmake' exec='relay'/></launch>"
    ),
    "src/group/tools_cmake/package.xml": _PACKAGE.format("tools_cmake"),
    "src/group/tools_cmake/CMakeLists.txt": _CMAKE,
    "src/group/tools_cmake/python/tools_cmake/__init__.py": "",
    "src/group/tools_cmake/python/tools_cmake/helper.py": "def word():\n    return 'from cmake'\n",
    "src/group/tools_cmake/scripts/relay.py": _RELAY,
    "job.yaml": (
        "search_path: [src]\nstop: {duration: 2s}\n"
        "nodes: [{executable: talker_py/talker, parameters: {rate: 4.0}}, "
        "{executable: tools_cmake/relay}]\n"
    ),
    "wrong.yaml": "search_path: [src]\nnodes: [{executable: tools_cmake/rely}]\n",
}


def _write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.mark.long
@pytest.mark.ros
def test_a_checkout_runs_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    pytest.importorskip("ament_index_python", reason="needs ROS's ament_index_python")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    _write(tmp_path, _FILES)
    launch = "src/talker_py/launch/all.launch.py"
    done = command("record", "--launch", launch, "--until", "2", "-o", "launched.mcap")
    assert done.returncode == 0, done.stderr
    with Trace.open("launched.mcap") as trace:
        heard = [trace.decode("/heard", data).data for _, _, data in trace.messages("/heard")]  # type: ignore[attr-defined]
        assert heard == ["from cmake"] * 8
        assert str(tmp_path / "cache") not in trace.job["resolved"]  # it may be emptied
    named = command("record", "job.yaml", "-o", "named.mcap")
    assert named.stdout.split()[1:4] == done.stdout.split()[1:4], named.stderr
    audit = command("audit", "job.yaml")
    assert "nothing found in 5 files" in audit.stdout + audit.stderr

    wrong = command("check", "wrong.yaml")
    assert (
        "wrong.yaml:2:22: package 'tools_cmake' has no executable 'rely'; did you mean 'relay'"
        in (wrong.stderr)
    )

    # Whether to trust a trace is found out without running anything.
    mark = tmp_path / "src/talker_py/setup_was_run"
    assert mark.exists()
    mark.unlink()
    listed = command("replay", "launched.mcap", "--job-folder", "src/talker_py/launch")
    assert listed.returncode == 2
    assert "src/talker_py/talker_py/talker.py\n" in listed.stderr
    assert not mark.exists()


@pytest.mark.long
@pytest.mark.ros
@pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="needs a C++ compiler"
)
def test_processes_of_a_checkout_find_its_modules_and_shares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    _write(tmp_path, _FILES)
    share = "from ament_index_python.packages import get_package_share_directory as share\n"
    asks = "".join(
        f"    open(share('{package}') + '/{file}')\n"
        for package, file in (("talker_py", "settings/p.yaml"), ("std_msgs", "package.xml"))
    )
    talker = tmp_path / "src/talker_py/talker_py/talker.py"
    talker.write_text(share + _TALKER.replace("    rclpy.init(", asks + "    rclpy.init("))
    job = (tmp_path / "job.yaml").read_text()
    (tmp_path / "job.yaml").write_text(job.replace("talker,", "talker, isolated: true,"))
    done = command("record", "job.yaml", "-o", "run.mcap")
    assert done.returncode == 0, done.stderr
    with Trace.open("run.mcap") as trace:
        heard = [trace.decode("/heard", data).data for _, _, data in trace.messages("/heard")]  # type: ignore[attr-defined]
    assert heard == ["from cmake"] * 8


@pytest.mark.long
def test_verify_leaves_shares_where_they_are(
    command: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    """A node may say where its share is; ``verify`` gives each run another HOME."""
    _write(
        tmp_path,
        {
            "say/package.xml": _PACKAGE.format("say"),
            "say/setup.py": (
                "import setuptools\nsetuptools.setup(data_files=[('share/say/a', ['x'])])"
            ),
            "say/x": "",
            "say/say/__init__.py": (
                "from ament_index_python.packages import get_package_share_directory\n"
                "from rclpy.node import Node\nclass N(Node):\n    def __init__(self):\n"
                "        super().__init__('n')\n"
                "        self.get_logger().info(get_package_share_directory('say'))\n"
            ),
            "job.yaml": "nodes: [{node: 'say:N'}]\nstop: {time: 0.1s}\n",
        },
    )
    done = command("verify", "job.yaml", "--runs", "2")
    assert done.returncode == 0, done.stdout


_NAMESPACES = {
    # No __init__.py: listed by name, found by find_namespace_packages, by setup.cfg, by nobody.
    "ws/plain/package.xml": _PACKAGE.format("plain"),
    "ws/plain/setup.py": "from setuptools import setup\nsetup(packages=['plain'], "
    "entry_points={'console_scripts': ['go = plain.main:main']})\n",
    "ws/plain/plain/main.py": "from .helper import word\n"
    + _TALKER.replace("tools_cmake", "found"),
    "ws/plain/plain/helper.py": "from listed.deep.words import word\n",
    "ws/found/package.xml": _PACKAGE.format("found"),
    "ws/found/setup.py": "from setuptools import find_namespace_packages, setup\n"
    "setup(packages=find_namespace_packages(where='code'), package_dir={'': 'code'})\n",
    "ws/found/code/found/helper.py": "from plain.helper import word\n",
    "ws/listed/package.xml": _PACKAGE.format("listed"),
    "ws/listed/setup.cfg": "[options]\npackages =\n  listed\n  listed.deep\n"
    "package_dir =\n  = python\n",
    "ws/listed/python/listed/deep/words.py": "from beside.inner import word\n",
    # An __init__.py beside package.xml: the folder of the package is not its module.
    "ws/beside/package.xml": _PACKAGE.format("beside"),
    "ws/beside/__init__.py": "raise ImportError('the folder of the package')\n",
    "ws/beside/setup.py": "from setuptools import find_packages, setup\n"
    "setup(packages=find_packages())\n",
    "ws/beside/beside/__init__.py": "",
    "ws/beside/beside/inner.py": "def word():\n    return 'from all'\n",
    "job.yaml": "search_path: [ws, ws/plain, ws/found]\nstop: {duration: 2s}\n"
    "nodes: [{executable: plain/go}]\n",
}


@pytest.mark.long
@pytest.mark.ros
def test_modules_without_an_init_and_an_init_beside_package_xml(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    _write(tmp_path, _NAMESPACES)
    done = command("record", "job.yaml", "-o", "run.mcap")
    assert done.returncode == 0, done.stderr
    with Trace.open("run.mcap") as trace:
        said = [trace.decode("/said", data).data for _, _, data in trace.messages("/said")]  # type: ignore[attr-defined]
    assert set(said) == {"from all"}
    audit = command("audit", "job.yaml")
    assert "nothing found in 6 files" in audit.stdout + audit.stderr
    listed = command("replay", "run.mcap", "--job-folder", tmp_path)
    assert "ws/beside/beside/inner.py\n" in listed.stderr
    assert "ws/plain/plain/main.py\n" in listed.stderr


def test_what_build_files_say(tmp_path: Path) -> None:
    _write(
        tmp_path,
        {
            "a/setup.cfg": (
                "[options]\npackage_dir =\n    = source\n"
                "[options.entry_points]\nconsole_scripts =\n  one = a.one:main\n"
            ),
            "a/setup.py": (
                "from setuptools import setup\n"
                "setup(entry_points='[console_scripts]\\ntwo = a.two:main [extra]\\n',\n"
                "      py_modules=['single'], scripts=['bin/three'], packages=['b', 'b.c'],\n"
                "      data_files=[('lib/a', ['four.py'])], package_dir={'': 'source'})\n"
            ),
            "a/pyproject.toml": (
                "[project.scripts]\nfive = 'a.five:main'\n"
                "[tool.poetry.scripts]\nsix = 'a.six:main'\nfive = 'old:main'\n"
            ),
            # What setuptools has below it: commands to derive from, functions that answer a list.
            "c/setup.py": (
                "import distutils.command.build_py as build\nfrom distutils import log\n"
                "import setuptools\nfrom setuptools.command.develop import develop\n"
                "def scripts_in_lib(kind):\n"
                "    before, kind.run = kind.run, lambda self: before(self)\n"
                "    return kind\n"
                "@scripts_in_lib\nclass Develop(develop):\n    pass\n"
                "class Build(build.build_py, object):\n    pass\n"
                "log.info('once more')\n"
                "setuptools.setup(cmdclass={'develop': Develop, 'build_py': Build},\n"
                "    packages=setuptools.find_packages() + ['c'],\n"
                "    entry_points={'console_scripts': ['seven = c:main']})\n"
            ),
            "c/c/__init__.py": "",
            "b/pyproject.toml": "project = 'no table'\n[tool.poetry]\nscripts = []\n",
            **dict.fromkeys(["a/source/single.py", "a/source/b/__init__.py"], ""),
            **dict.fromkeys(["a/bin/three", "a/four.py", "a/test/__init__.py"], ""),
            "broken/setup.py": "raise SystemExit('no')",
            "broken/broken/__init__.py": "",
        },
    )
    a = SourcePackage("a", tmp_path / "a")
    assert executables(SourcePackage("b", tmp_path / "b")) == {}
    c = SourcePackage("c", tmp_path / "c")
    assert (executables(c), modules(c)) == ({"seven": "c:main"}, {"c": tmp_path / "c" / "c"})
    assert executables(a) == {
        "one": "a.one:main",
        "two": "a.two:main",
        "three": tmp_path / "a" / "bin" / "three",
        "four.py": tmp_path / "a" / "four.py",
        "five": "a.five:main",
        "six": "a.six:main",
    }
    source = tmp_path / "a" / "source"
    assert modules(a) == {"single": source / "single.py", "b": source / "b"}
    broken = SourcePackage("broken", tmp_path / "broken")
    assert (executables(broken), modules(broken)) == (
        {},
        {"broken": tmp_path / "broken" / "broken"},
    )


def test_a_program_that_nobody_has_built_is_said_to_be_that(tmp_path: Path) -> None:
    cmake = (
        "project(driver)\nadd_executable(${PROJECT_NAME}_node src/main.cpp)\n"
        'rclcpp_components_register_node(parts PLUGIN "d::P"\n  EXECUTABLE part)\n'
        "# add_executable(old)\ninstall(PROGRAMS run.py DESTINATION lib/${PROJECT_NAME})\n"
    )
    _write(
        tmp_path,
        {
            "driver/package.xml": _PACKAGE.format("driver"),
            "driver/CMakeLists.txt": cmake,
            "driver/run.py": "",
            "none/package.xml": _PACKAGE.format("none"),
            "bad/package.xml": _PACKAGE.format("bad"),
            "bad/setup.py": "import nothing_of_that_name",
        },
    )
    with unbuilt_packages([tmp_path]):
        for target, said in [
            ("driver/part", "driver/part is a program that is not built (CMakeLists.txt of d"),
            (
                "driver/driver_nod",
                "did you mean 'driver_node'? It has run.py; once it is built",
            ),
            ("none/x", "package 'none' has no executable 'x': it has none"),
            (
                "bad/x",
                "package 'bad' has no executable 'x': it has none; its setup.py, asked without "
                "setuptools, failed: ModuleNotFoundError: No module named 'nothing_of_that_name'",
            ),
        ]:
            with pytest.raises(JobError) as caught:
                find_executable(target, where="job.yaml:1:1")
            assert said in str(caught.value)
            assert str(caught.value) == f"job.yaml:1:1: {why_not_runnable(*target.split('/'))}"


def test_the_workspace_around_a_launch_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _write(tmp_path, {"ws/src/p/package.xml": "", "git/.git/x": "", "git/a/p/package.xml": ""})
    _write(tmp_path, {"alone/p/package.xml": "", "none/launch/x": ""})
    for file, folder, around in [
        ("ws/src/p/launch/x", "ws", ["ws/src"]),
        ("git/a/p/launch/x", "alone", ["git"]),
        ("git/a/p/launch/x", "git", ["git"]),
        ("git/a/p/launch/x", ".", ["git", "."]),
        ("alone/p/launch/x", "git", ["alone/p"]),
        ("alone/p/launch/x", "alone", ["alone/p", "alone"]),
        ("none/launch/x", ".", []),
    ]:
        monkeypatch.chdir(tmp_path / folder)
        assert workspaces_of(tmp_path / file) == [tmp_path / one for one in around]
