"""``script:`` and ``module:``: programs run as ``__main__``, each in one of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import JobError

pytestmark = pytest.mark.ros

TESTS = """
from __future__ import annotations
import dataclasses
import multiprocessing
import pickle
import sys
import typing
import unittest

from beside import VALUE

@dataclasses.dataclass
class Point:
    kind: typing.ClassVar[str] = 'point'
    x: int = 0

def double(x):
    return Point(2 * x)

class Tests(unittest.TestCase):
    def test_what_is_defined_here_is_found(self):
        self.assertEqual([f.name for f in dataclasses.fields(Point)], ['x'])
        self.assertIs(type(pickle.loads(pickle.dumps(Point(3)))), Point)
        self.assertIs(sys.modules['__main__'].Point, Point)

    def test_other_processes(self):
        for method in 'fork', 'spawn':
            with multiprocessing.get_context(method).Pool(1) as pool:
                self.assertEqual(pool.map(double, [2]), [Point(4)])

    def test_that_fails(self):
        self.assertEqual(VALUE, 2)

if __name__ == '__main__':
    unittest.main()
"""

SHOWS = """
import json
import sys
main = sys.modules['__main__']
assert vars(main) is globals()
spec = main.__spec__
print(json.dumps({
    'file': main.__file__,
    'spec': spec and spec.name,
    'package': main.__package__,
    'loader': main.__loader__.name,
    'path': sys.path[0],
    'words': sys.argv[1:],
    'names': sorted(vars(main)),
}))
"""


@pytest.fixture
def programs(tmp_path: Path) -> Path:
    (tmp_path / "tests.py").write_text(TESTS)
    (tmp_path / "beside.py").write_text("VALUE = 1\n")
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts/shows.py").write_text(SHOWS)
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack/__init__.py").write_text("")
    (tmp_path / "pack/inner.py").write_text(SHOWS)
    (tmp_path / "pack/__main__.py").write_text("from . import more\n" + SHOWS)
    (tmp_path / "pack/more.py").write_text("")
    (tmp_path / "plain").mkdir()
    (tmp_path / "plain/__init__.py").write_text("")
    return tmp_path


def shown(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines() if line.startswith("{")]


def test_unittest_finds_its_tests_and_its_status_is_that_of_the_command(
    programs: Path, rsltrace: Callable[..., Any]
) -> None:
    (programs / "job.yaml").write_text("nodes: [{script: tests.py, arguments: [-v]}]\n")
    done = rsltrace("record", "job.yaml", "-o", "run.mcap")
    assert "Ran 3 tests" in done.stderr, done.stderr
    assert "FAILED (failures=1)" in done.stderr, done.stderr
    assert "test_that_fails (__main__.Tests" in done.stderr
    assert done.returncode == 1
    (programs / "beside.py").write_text("VALUE = 2\n")
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", "--force")
    assert "Ran 3 tests" in done.stderr
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_programs_find_what_python_gives_them(programs: Path, rsltrace: Callable[..., Any]) -> None:
    (programs / "job.yaml").write_text(
        "nodes:\n"
        "- {script: scripts/shows.py, arguments: [-a, 1]}\n"
        "- {module: pack.inner, arguments: [-b]}\n"
        "- module: pack\n"
    )
    done = rsltrace("record", "job.yaml", "-o", "run.mcap")
    assert done.returncode == 0, done.stderr
    natively = []
    for words in (["scripts/shows.py", "-a", "1"], ["-m", "pack.inner", "-b"], ["-m", "pack"]):
        run = subprocess.run(
            [sys.executable, *words], cwd=programs, capture_output=True, text=True, check=True
        )
        natively += shown(run.stdout)[-1:]
    found = [one for one in shown(done.stdout) if one["spec"] or one["words"] == ["-a", "1"]]
    assert found == natively
    assert "__file__" in found[0]["names"]


@pytest.mark.long
def test_the_files_are_in_the_trace_and_a_replay_names_them(
    programs: Path, rsltrace: Callable[..., Any]
) -> None:
    from rsltrace import Trace
    from rsltrace.trace.format import METADATA_SOURCES

    (programs / "job.yaml").write_text("nodes: [{script: scripts/shows.py}, {module: pack}]\n")
    assert rsltrace("record", "job.yaml", "-o", "run.mcap").returncode == 0
    with Trace.open(programs / "run.mcap") as trace:
        assert {"file:scripts/shows.py", "pack.__main__"} <= set(trace.metadata(METADATA_SOURCES))
    (programs / "scripts/shows.py").write_text(SHOWS + "# changed\n")
    again = rsltrace("replay", "run.mcap")
    assert again.returncode == 0, again.stderr
    assert "scripts/shows.py" in again.stderr
    assert "has changed" in again.stderr
    looked = rsltrace("audit", "job.yaml")
    assert "nothing found in 4 files" in looked.stderr + looked.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("script: script/shows.py", "there is no such file (there is no folder 'script' either)"),
        ("script: scripts/show.py", "did you mean 'scripts/shows.py'?"),
        ("script: scripts", "'scripts': is not a file"),
        ("script: job.yaml", "job.yaml is not a Python program"),
        ("module: pack.outer", "there is no module 'pack.outer' to run"),
        ("module: nowhere.at_all", "there is no module 'nowhere.at_all' to run"),
        ("module: plain", "there is no module 'plain' to run"),
        ("module: _heapq", "module '_heapq' is no Python source"),
        ("module: pack/inner.py", "a file is named by 'script: pack/inner.py'"),
        ("module: pack.inner:main", "a function is named by 'main: pack.inner:main'"),
        ("scripts/shows.py", "write {script: scripts/shows.py}"),
    ],
)
def test_what_cannot_be_run_is_refused_at_its_line(entry: str, said: str, programs: Path) -> None:
    from rsltrace.job import load_job
    from rsltrace.run import run

    (programs / "job.yaml").write_text(f"nodes:\n- {entry}\n")
    with pytest.raises(JobError) as refused:
        run(load_job(programs / "job.yaml"), programs / "run.mcap")
    assert said in str(refused.value)
    assert "job.yaml:2:" in str(refused.value)
    assert not (programs / "run.mcap").exists()


EARLY = {
    # rclpy.init() in a module that the main's imports, as rosboard has it.
    "early/__init__.py": "",
    "early/ros.py": (
        "import sys\nimport rclpy\nrclpy.init(args=sys.argv)\nNODES = []\n"
        "def make(name):\n    NODES.append(rclpy.create_node(name))\n    return NODES[0]\n"
    ),
    "early/node.py": (
        "import threading\nfrom early import ros\n"
        "def main():\n    import rclpy\n    from early.later import say\n"
        "    node = ros.make('early')\n"
        "    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()\n"
        "    node.create_timer(0.5, lambda: say(node, len(ros.NODES)))\n"
        "    threading.Event().wait()\n"
    ),
    "early/later.py": (
        "from early.ros import NODES\n"
        "def say(node, count):\n"
        "    node.get_logger().info(f'{node.get_name()} {count} {len(NODES)}')\n"
    ),
    # The whole node is made when the module is imported.
    "whole.py": (
        "import rclpy\nrclpy.init()\nnode = rclpy.create_node('whole')\n"
        "node.create_timer(0.5, lambda: node.get_logger().info('whole'))\n"
        "def main():\n    rclpy.spin(node)\n"
    ),
    "swallows.py": (
        "import rclpy\ntry:\n    rclpy.init()\nexcept BaseException:\n    pass\n"
        "def main():\n    node = rclpy.create_node('swallows')\n"
        "    node.create_timer(0.5, lambda: node.get_logger().info('swallows'))\n"
        "    rclpy.spin(node)\n"
    ),
    "asks.py": (
        "import rclpy\nCONTEXT = rclpy.get_default_context()\nassert not rclpy.ok()\n"
        "def main():\n    rclpy.init()\n    assert CONTEXT.ok()\n"
        "    node = rclpy.create_node('asks', context=CONTEXT)\n"
        "    node.create_timer(0.5, lambda: node.get_logger().info('asks'))\n"
        "    rclpy.spin(node)\n"
    ),
    "job.yaml": (
        "stop: {duration: 0.7s}\nnodes:\n"
        "  - {main: 'early.node:main'}\n  - {main: 'early.node:main', name: other}\n"
        "  - {main: 'whole:main'}\n  - {main: 'swallows:main'}\n  - {main: 'asks:main'}\n"
    ),
    "hosted.yaml": "stop: {duration: 1s}\nnodes: [{node: 'whole:main'}]\n",
    "wrong.yaml": "stop: {duration: 1s}\nnodes: [{main: 'early.node:mian'}]\n",
}


def test_a_module_that_initializes_rclpy_when_it_is_imported(
    tmp_path: Path, rsltrace: Callable[..., Any]
) -> None:
    for name, text in EARLY.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap")
    assert done.returncode == 0, done.stderr
    said = [line.split("]: ")[1] for line in done.stderr.splitlines() if "]: " in line]
    assert sorted(said) == ["asks", "early 1 1", "other 1 1", "swallows", "whole"]
    again = rsltrace("record", "job.yaml", "-o", "again.mcap")
    assert again.stdout == done.stdout
    hosted = rsltrace("record", "hosted.yaml", "-o", "hosted.mcap")
    assert "move rclpy.init() into a function that makes the node and spins" in hosted.stderr
    wrong = rsltrace("record", "wrong.yaml", "-o", "wrong.mcap")
    assert wrong.returncode == 3
    assert "has no attribute 'mian'" in wrong.stderr


TALK = """
import rclpy

def main():
    rclpy.init()
    node = rclpy.create_node('talker')
    node.create_timer(0.3, lambda: None)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
"""


def test_exiting_with_what_main_returns_is_returning(
    tmp_path: Path, rsltrace: Callable[..., Any]
) -> None:
    """An installed console script is ``sys.exit(main())``, an unbuilt one is called."""
    (tmp_path / "job.yaml").write_text("nodes: [{script: talk.py}]\nstop: {duration: 1s}\n")
    said = set()
    for call in ("main()", "sys.exit(main())"):
        (tmp_path / "talk.py").write_text(f"import sys\n{TALK}\n{call}\n")
        done = rsltrace("record", "job.yaml", "--force")
        assert done.returncode == 0, done.stderr
        said.add(done.stdout)
    assert len(said) == 1
    assert "digest" in said.pop()
