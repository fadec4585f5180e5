"""Packages that nobody ran colcon on: their interfaces are classes, their shares are found."""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Callable, Iterator
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.adapters.workspace import cache, interfaces
from rsltrace.adapters.workspace.build_files import entry_points, name_and_version
from rsltrace.adapters.workspace.imports import unbuilt_packages
from rsltrace.adapters.workspace.installs import share_prefix
from rsltrace.adapters.workspace.interfaces import interface_makers, module_name
from rsltrace.errors import JobError, SetupError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.source_packages import SourcePackage, source_packages
from rsltrace.trace.reader import Trace

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
pytest.importorskip("rosidl_adapter", reason="needs ROS's rosidl")

_NODE = """
import os
from importlib.metadata import entry_points, version
from ament_index_python.packages import get_package_share_directory, get_packages_with_prefixes
from arm.msg import Joint
from arm_interfaces.action import Move
from arm_interfaces.srv import Grip
from rclpy.action import ActionClient, ActionServer
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

class Arm(Node):
    def __init__(self):
        super().__init__("arm")
        self.joints = self.create_publisher(Joint, "joint", 10)
        self.create_subscription(Joint, "joint", self.on_joint, 10)
        self.create_service(Grip, "grip", self.grip)
        self.grip_client = self.create_client(Grip, "grip")
        self.server = ActionServer(self, Move, "move", self.move)
        self.mover = ActionClient(self, Move, "move")
        with open(os.path.join(get_package_share_directory("arm"), "limits.yaml")) as file:
            self.get_logger().info("limits " + file.read().strip())
        assert os.path.isdir(get_package_share_directory("std_msgs"))
        assert "arm_interfaces" in get_packages_with_prefixes()
        (tool,) = entry_points(group="arm.tools")
        assert tool.load() is Arm
        self.get_logger().info(f"{tool.name} of {version('arm')}, {version('arm_interfaces')}")
        self.create_timer(1.0, self.start)

    def start(self):
        joint = Joint(place=Joint.ELBOW, name="left")
        assert deserialize_message(serialize_message(joint), Joint) == joint
        self.joints.publish(joint)
        self.grip_client.call_async(Grip.Request(force=2.0)).add_done_callback(self.say)
        self.mover.send_goal_async(Move.Goal(to=3), feedback_callback=self.on_feedback)

    def on_joint(self, joint):
        self.get_logger().info(f"{joint.name} {joint.place} {joint.gains.tolist()}")

    def grip(self, request, response):
        response.joint.place = int(request.force)
        return response

    def say(self, future):
        self.get_logger().info(f"place {future.result().joint.place}")

    def move(self, goal):
        goal.publish_feedback(Move.Feedback(at=goal.request.to))
        goal.succeed()
        return Move.Result()

    def on_feedback(self, message):
        self.get_logger().info(f"at {message.feedback.at}")
"""

_SETUP = """
from glob import glob
from setuptools import find_packages, setup
setup(name="arm", version="1.2.3", entry_points={
    "console_scripts": ["arm = arm.node:main"], "arm.tools": ["gripper = arm.node:Arm"],
}, packages=find_packages(), data_files=[
    ("share/ament_index/resource_index/packages", ["resource/arm"]),
    ("share/arm", glob("config/*.yaml")),
])
"""

_FILES = {
    "src/arm_interfaces/package.xml": (
        "<package><name>arm_interfaces</name><version>0.4.0</version></package>"
    ),
    "src/arm_interfaces/srv/Grip.srv": "float32 force\n---\narm/Joint joint\n",
    "src/arm_interfaces/action/Move.action": "int8 to\n---\n---\nint8 at\n",
    "src/arm/package.xml": "<package><name>arm</name></package>",
    "src/arm/setup.py": _SETUP,
    "src/arm/config/limits.yaml": "1 to 2",
    "src/arm/msg/Joint.msg": (
        "uint8 ELBOW=7\nstd_msgs/Header header\nuint8 place\n"
        "string<=8 name\nfloat64[2] gains [1, 2]\n"
    ),
    "src/arm/arm/__init__.py": "",
    "src/arm/arm/node.py": _NODE,
    "job.yaml": (
        "search_path: [src, src/arm]\nnodes: [{node: 'arm.node:Arm'}]\nstop: {time: 1.5s}\n"
    ),
}


@pytest.fixture(scope="module")
def caches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.delenv("AMENT_PREFIX_PATH", raising=False)
        patch.setattr(interfaces, "_TOLD_EVERY_S", float("inf"))
        cache._root.cache_clear()
        yield folder
    cache._root.cache_clear()


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> tuple[Path, list[Any]]:
    """The job recorded twice: with an empty cache, and with what the first run left there."""
    folder = tmp_path_factory.mktemp("job")
    _write(folder, _FILES)
    job = load_job(folder / "job.yaml")
    return folder, [run(job, folder / f"{name}.mcap") for name in "ab"]


def _write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def test_interfaces_of_source_folders_are_used_as_if_built(
    runs: tuple[Path, list[Any]], command: Callable[..., Any]
) -> None:
    folder, (first, _) = runs
    assert first.error is None, first.error
    shown = command("cat", folder / "a.mcap", "--json").stdout
    for text in (
        "limits 1 to 2",
        "gripper of 1.2.3, 0.4.0",
        "left 7 [1.0, 2.0]",
        "place 2",
        "at 3",
    ):
        assert text in shown
    with Trace.open(folder / "a.mcap") as trace:
        schemas = {channel.topic: channel.schema_text for channel in trace.channels.values()}
    assert "string<=8 name" in schemas["/joint"]


def test_the_run_that_makes_the_classes_is_like_the_next(runs: tuple[Path, list[Any]]) -> None:
    folder, results = runs
    assert results[0].digest == results[1].digest
    assert (folder / "a.mcap").read_bytes() == (folder / "b.mcap").read_bytes()


def test_a_search_for_metadata_is_no_file_that_a_node_reads(runs: tuple[Path, list[Any]]) -> None:
    _, (first, _) = runs
    assert not [count.call for count in first.guarded if "stat(" in count.call]


def test_nothing_of_it_is_left_behind(runs: tuple[Path, list[Any]]) -> None:
    assert not [name for name in sys.modules if name.partition(".")[0] in ("arm", "arm_interfaces")]
    assert not [
        f for f in sys.meta_path if type(f).__module__.startswith("rsltrace.adapters.workspace")
    ]


def test_natively_they_are_refused_by_name(runs: tuple[Path, list[Any]]) -> None:
    from rclpy.type_support import check_for_type_support

    folder = runs[0] / "src"
    for native in (False, True):
        with unbuilt_packages([folder], native=native) as workspace:
            joint = import_module("arm.msg").Joint
            joint.__class__._TYPE_SUPPORT = None
            assert joint(name="left").name == "left"
            assert workspace.made >= {"arm"}
            if not native:
                check_for_type_support(joint)
                continue
            with pytest.raises(SetupError, match=r"arm in .*/src/arm has not been built.*--native"):
                check_for_type_support(joint)


def test_classes_and_hashes_are_those_that_a_build_makes(
    tmp_path: Path,
    caches: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    share = Path(sys.prefix, "share", "std_srvs")
    if not (share / "srv" / "SetBool.json").is_file():
        pytest.skip("needs the definitions of std_srvs")
    _write(tmp_path, {"package.xml": "<package><name>std_srvs</name></package>"})
    (tmp_path / "srv").mkdir()
    (tmp_path / "srv" / "SetBool.srv").write_bytes((share / "srv" / "SetBool.srv").read_bytes())
    maker = interface_makers(source_packages([tmp_path]))["std_srvs"]
    of_node = io.StringIO()  # what a node prints is the same in the first run and the next
    monkeypatch.setattr(sys, "stderr", of_node)
    maker.make("srv", "SetBool")
    made = maker.prefix
    assert "making Python classes of std_srvs/srv/SetBool, once" in capfd.readouterr().err
    interface_makers(source_packages([tmp_path]))["std_srvs"].make("srv", "SetBool")
    assert (capfd.readouterr().err, of_node.getvalue()) == ("", "")
    (site,) = import_module("std_srvs").__path__
    for ours, built in (
        (made / "site-packages/std_srvs/srv/_set_bool.py", Path(site, "srv", "_set_bool.py")),
        (made / "share/std_srvs/srv/SetBool.json", share / "srv" / "SetBool.json"),
    ):
        assert ours.read_text() == built.read_text()


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("int8 y\nfloat6 x\n", r"msg/Odd\.msg:2: rosidl cannot .* 'float6' is not a type of ROS 2"),
        ("# late\nint8\n", r"msg/Odd\.msg:2: .* 'int8' has no name: write a type and a name"),
        ("std_msgs/msg/Bool x\n", r"msg/Odd\.msg:1: .* 'std_msgs/msg/Bool' .*: write package/Name"),
        ("std_msgs/Time at\n", r"msg/Odd\.msg:1: there is no Time\.msg in the package 'std_msgs'"),
        ("\nmoon_msgs/Rock rock\n", r"msg/Odd\.msg:2: it uses types of .*'moon_msgs'"),
        (
            "# late\nbool x\nduration wait  # s\n",
            r"Odd\.msg:3: 'duration' .* ROS 1: write builtin_",
        ),
        ("time[] at\n", r"Odd\.msg:1: 'time' is a type of ROS 1: write builtin_interfaces/Time"),
        ("Header header\n", r"Odd\.msg:1: 'Header' is a type of ROS 1: write std_msgs/Header"),
        ("Fine f\nNone[3] x\n", r"Odd\.msg:2: there is no None\.msg in the package 'odd'"),
        ("Fine f\nodd/msg/Other[<=3] x\n", r"msg/Other\.msg:1: it and odd/Odd need each other"),
    ],
)
def test_files_that_cannot_be_understood_are_named_and_stop_no_others(
    tmp_path: Path, caches: Path, text: str, said: str
) -> None:
    files = {"msg/Odd.msg": text, "msg/Other.msg": "Odd odd\n", "msg/Fine.msg": "int32 x\n"}
    _write(tmp_path, {"package.xml": "<package><name>odd</name></package>", **files})
    folder = caches / "rsltrace" / "interfaces"
    before = {*folder.glob(".new*")}  # of a test that cuts one off
    maker = interface_makers(source_packages([tmp_path]))["odd"]
    with pytest.raises(JobError, match=said):
        maker.make("msg", "Odd")
    maker.make("msg", "Fine")
    assert maker.module_of("msg", "Fine").is_file()
    assert not maker.module_of("msg", "Odd").exists()
    assert {*folder.glob(".new*")} <= before


def test_only_what_is_imported_is_made_and_what_is_ready_is_kept(
    tmp_path: Path, caches: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    files = {
        "far/package.xml": "<package><name>far_msgs</name></package>",
        "far/msg/Leaf.msg": "int32 x\n",
        "far/msg/Unused.msg": "moon_msgs/Rock rock\n",
        "near/package.xml": "<package><name>near_msgs</name></package>",
        "near/msg/HTTPBox2D.msg": "far_msgs/Leaf[2] leaves\nInner inner\n",
        "near/msg/parts/Inner.msg": "std_msgs/Header header\n",
        "near/msg/Other.msg": "time t\n",
        "near/srv/Ask.srv": "Inner inner\n---\n",
        **{f"near/action/{name}.action": "---\n---\n" for name in "ABCDEFG"},
    }
    _write(tmp_path, files)

    def made() -> list[str]:
        folders = (caches / "rsltrace" / "interfaces").glob("*_msgs-*/site-packages/*/*")
        return sorted(path.name for folder in folders for path in folder.glob("_[a-z]*.py"))

    with unbuilt_packages([tmp_path]) as workspace:
        module = import_module("near_msgs.msg")
        assert dir(module) == ["HTTPBox2D", "Inner", "Other"]
        assert made() == []
        box = module.HTTPBox2D()
        assert made() == ["_http_box2_d.py", "_inner.py", "_leaf.py"]
        assert "of near_msgs/msg/HTTPBox2D, and of what that uses (interface files: 2), once" in (
            capfd.readouterr().err
        )
        assert box.leaves[1].x == 0
        assert type(box.inner) is import_module("near_msgs.msg._inner").Inner
        assert not hasattr(module, "Nothing")
        with pytest.raises(JobError, match=r"Other\.msg:1: 'time' is a type of ROS 1"):
            _ = module.Other
        import_module("near_msgs.srv._ask")
        assert capfd.readouterr().err.count("note") == 1
        assert import_module("near_msgs.srv").Ask_Request().inner is not None
        share = workspace.interfaces("near_msgs").prefix / "share" / "near_msgs"  # type: ignore[union-attr]
        assert (share / "srv" / "Ask_Event.json").is_file()
        assert '"far_msgs/msg/Leaf"' in (share / "msg" / "HTTPBox2D.json").read_text()
    with unbuilt_packages([tmp_path]):
        import_module("near_msgs.msg").HTTPBox2D()
        assert capfd.readouterr().err == ""
        exec("from near_msgs.action import A, B")  # rosidl is started once for a statement
        assert capfd.readouterr().err.count("of near_msgs/action/A, B, once") == 1
        exec("from near_msgs.action import *")
        assert capfd.readouterr().err == (
            "rsltrace: note: making Python classes of near_msgs/action/C, D, E, F, G, once\n"
        )


@given(st.from_regex(r"[A-Z][A-Za-z0-9]{0,12}", fullmatch=True))
def test_modules_are_named_as_rosidl_names_them(name: str) -> None:
    from rosidl_pycommon import convert_camel_case_to_lower_case_underscore as named

    assert module_name(name) == named(name)


def test_packages_are_found_as_colcon_finds_them(tmp_path: Path) -> None:
    xml = "<package><name>{}</name></package>"
    _write(
        tmp_path,
        {
            "a/package.xml": xml.format("a"),
            "a/inner/package.xml": xml.format("in_a_package"),
            "deep/er/b/package.xml": xml.format("b"),
            "ignored/COLCON_IGNORE": "",
            "ignored/c/package.xml": xml.format("c"),
            "build/d/package.xml": xml.format("d"),
            ".hidden/e/package.xml": xml.format("e"),
            "broken/package.xml": "<package>",
        },
    )
    assert sorted(source_packages([tmp_path])) == ["a", "b"]
    scripts = tmp_path / "a" / "scripts"
    scripts.mkdir()
    assert sorted(source_packages([scripts])) == ["a"]


def test_shares_are_laid_out_as_cmake_installs_them(tmp_path: Path, caches: Path) -> None:
    cmake = """
        project(rover)
        install(DIRECTORY launch/ DESTINATION share/${PROJECT_NAME})  # its content
        install(DIRECTORY maps models DESTINATION share/${PROJECT_NAME}/data
                PATTERN "*.tmp" EXCLUDE)
        install(FILES config/rover.yaml DESTINATION "share/${PROJECT_NAME}")
        install(PROGRAMS scripts/go.py DESTINATION lib/${PROJECT_NAME})
    """
    names = ("launch/all.launch.py", "maps/m.pgm", "models/r.urdf", "config/rover.yaml")
    _write(
        tmp_path,
        {
            "package.xml": "<package><name>rover</name></package>",
            "CMakeLists.txt": cmake,
            **dict.fromkeys((*names, "scripts/go.py"), "x"),
        },
    )
    share = share_prefix(SourcePackage("rover", tmp_path)) / "share" / "rover"
    for name in (*names, "all.launch.py", "rover.yaml", "data/maps/m.pgm", "data/models/r.urdf"):
        assert (share / name).read_text() == "x", name
    assert not (share / "go.py").exists()
    assert not re.search("CMake", " ".join(os.listdir(share)))


def test_modules_that_are_blocked_stop_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "somebody_blocks_this", None)  # its import is an ImportError
    with unbuilt_packages([]) as workspace:
        assert not workspace.made


def test_entry_points_are_read_from_all_that_says_them(tmp_path: Path) -> None:
    _write(
        tmp_path,
        {
            "setup.py": """from setuptools import setup
setup(entry_points='''
[a]
One = m:one [extra]
''')""",
            "setup.cfg": "[options.entry_points]\na =\n    two = m:two\nb = three=m:three\n",
            "pyproject.toml": """
[project]
name = "tool-box"
version = "2.0"
[project.scripts]
four = "m:four"
[project.entry-points.c]
five = "m"
[tool.poetry.scripts]
six = "m:six"
""",
        },
    )
    assert entry_points(tmp_path) == {
        "a": {"One": "m:one [extra]", "two": "m:two"},
        "b": {"three": "m:three"},
        "console_scripts": {"six": "m:six", "four": "m:four"},
        "c": {"five": "m"},
    }
    assert name_and_version(tmp_path) == ("tool-box", "2.0")


def test_what_is_installed_counts_and_what_is_nowhere_is_not_found(tmp_path: Path) -> None:
    _write(
        tmp_path, {"p/package.xml": "<package><name>pytest</name><version>0</version></package>"}
    )
    with unbuilt_packages([tmp_path]):
        assert metadata.version("pytest") == pytest.__version__
        with pytest.raises(metadata.PackageNotFoundError):
            metadata.version("nowhere_to_be_found")


def test_a_long_import_says_how_far_it_is_and_loses_nothing_when_it_is_cut_off(
    tmp_path: Path,
    caches: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    files = {f"msg/M{number}.msg": "int32 x\n" for number in range(4)}
    _write(tmp_path, {"package.xml": "<package><name>long_msgs</name></package>", **files})
    monkeypatch.setattr(interfaces, "_TOLD_EVERY_S", 0.0)
    told: list[str] = []

    def cut_off(text: str) -> None:
        told.append(text)
        if text.startswith("2 of 4"):
            raise KeyboardInterrupt

    monkeypatch.setattr(interfaces, "_tell", cut_off)
    maker = interface_makers(source_packages([tmp_path]))["long_msgs"]
    with pytest.raises(KeyboardInterrupt):
        maker.make("msg", "M0", "M1", "M2", "M3")
    assert told[0] == "making Python classes of long_msgs/msg/M0, M1, M2, M3, once"
    assert told[1] == "1 of 4 interface files are ready for long_msgs/msg/M0, M1, M2, M3"
    assert all(maker.module_of("msg", name).is_file() for name in ("M0", "M1"))
    assert not maker.module_of("msg", "M3").is_file()
