"""The cause of a divergence is the code, or the entry of the job, of the node that shows it."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.diff import diff_files
from rsltrace.diff.facts.causes import Verdict
from rsltrace.diff.result import Diff
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

_TALK = """#!/usr/bin/env python3
import rclpy
from std_msgs.msg import Float64
STEP = 0.5
def main():
    rclpy.init()
    node = rclpy.create_node("talk")
    out = node.create_publisher(Float64, "speed", 10)
    def tick():
        from robot_lib import gains
        out.publish(Float64(data=STEP * gains.SCALE))
    node.create_timer(0.1, tick)
    rclpy.spin(node)
main()
"""
_LISTEN = """#!/usr/bin/env python3
import rclpy
from std_msgs.msg import Float64
rclpy.init()
node = rclpy.create_node("listen")
out = node.create_publisher(Float64, "double", 10)
node.create_subscription(Float64, "speed", lambda m: out.publish(Float64(data=2 * m.data)), 10)
rclpy.spin(node)
"""
_CMAKE = """
project(robot)
ament_python_install_package(robot_lib)
install(PROGRAMS scripts/talk.py DESTINATION lib/${PROJECT_NAME})
install(PROGRAMS scripts/listen.py DESTINATION lib/${PROJECT_NAME} RENAME listen)
"""
_FILES = {
    "package.xml": "<package format='3'><name>robot</name></package>",
    "CMakeLists.txt": _CMAKE,
    "robot_lib/__init__.py": "",
    "robot_lib/gains.py": "SCALE = 2.0\n",
    "scripts/talk.py": _TALK,
    "scripts/listen.py": _LISTEN,
    "job.yaml": "nodes: [{executable: robot/talk.py}, {executable: robot/listen}]\n"
    "stop: {duration: 500ms}\n",
}


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in _FILES.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def cause(a: str, b: str) -> list[str]:
    divergence = diff_files(a, b).divergences[0]
    return [one.key or one.place for one in divergence.settings]


@pytest.mark.parametrize(
    ("changed", "before", "after", "named"),
    [
        ("scripts/talk.py", "STEP = 0.5", "STEP = 0.25", "file robot/talk.py"),
        ("scripts/listen.py", "2 * m", "3 * m", "file robot/listen"),
        ("robot_lib/gains.py", "2.0", "3.0", "code of module robot_lib.gains"),
    ],
)
def test_of_a_script_that_cmake_installs_and_what_it_imports_later(
    package: Path, command: Callable[..., Any], changed: str, before: str, after: str, named: str
) -> None:
    """Also that of the other node differs, in a way that does not show."""
    assert command("record", "job.yaml", "-o", "a.mcap").returncode == 0
    for name in ("scripts/talk.py", "scripts/listen.py"):
        (package / name).write_text((package / name).read_text() + "UNUSED = 1\n")
    (package / changed).write_text((package / changed).read_text().replace(before, after))
    assert command("record", "job.yaml", "-o", "b.mcap").returncode == 0
    of_node = "file robot/listen" if named.endswith("listen") else "file robot/talk.py"
    assert set(cause("a.mcap", "b.mcap")) == {named, of_node}
    told = command("replay", "a.mcap").stderr
    assert [line.split()[0] for line in told.splitlines() if "has changed" in line] == [
        *(["robot_lib.gains"] if "gains" in named else []),
        "robot/talk.py",
        "robot/listen",
    ]


def test_a_module_that_only_the_longer_run_has_loaded_is_no_cause(
    package: Path, command: Callable[..., Any]
) -> None:
    command("record", "job.yaml", "-o", "a.mcap")
    command("record", "job.yaml", "--until", "0.05", "-o", "b.mcap")
    with Trace.open("a.mcap") as a, Trace.open("b.mcap") as b:
        loaded = [set(trace.metadata(METADATA_SOURCES)) for trace in (a, b)]
    assert loaded[0] - loaded[1] == {"robot_lib", "robot_lib.gains"}
    found = diff_files("a.mcap", "b.mcap")
    assert [one.place for one in found.settings if "module" in one.place] == []


_COUNTER = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import Float64
class Counter(Node):
    def __init__(self):
        super().__init__("counter")
        self.gain = self.declare_parameter("gain", 1.0).value
        self.declare_parameter("unused", 1.0)
        self.out = self.create_publisher(Float64, "count", 10)
        self.create_timer(0.1, lambda: self.out.publish(Float64(data=self.gain)))
def main():
    rclpy.init()
    rclpy.spin(Counter())
"""
_ENTRY = "- {%s, namespace: %s, parameters: {gain: %s, unused: %s}}\n"


@pytest.mark.parametrize("kind", ["node: 'm:Counter'", "main: 'm:main'"])
def test_of_two_similar_entries_it_is_that_of_the_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., Any], kind: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("m.py").write_text(_COUNTER)
    for name, changed in (("a", 1.0), ("b", 2.0)):
        entries = _ENTRY % (kind, "/one", 1.0, changed) + _ENTRY % (kind, "/two", changed, 1.0)
        Path("job.yaml").write_text(f"nodes:\n{entries}stop: {{duration: 500ms}}\n")
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    every = diff_files("a.mcap", "b.mcap", everything=True).divergences
    named = {d.one.node: [one.key for one in d.settings] for d in every if d.one is not None}
    assert named == {
        "/one/counter": ["nodes.0.parameters.unused"],
        "/two/counter": ["nodes.1.parameters.gain"],
    }


_FACTORY = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import Float64
class Item(Node):
    def __init__(self, number):
        super().__init__(f"item{number}")
        self.gain = self.declare_parameter("gain", 1.0 + CHANGE * (number == 2)).value
        self.out = self.create_publisher(Float64, f"count{number}", 10)
        self.create_timer(0.1, lambda: self.out.publish(Float64(data=self.gain)))
def main():
    rclpy.init()
    executor = rclpy.executors.SingleThreadedExecutor()
    for item in [Item(number) for number in range(4)]:
        executor.add_node(item)
    executor.spin()
"""


def record_both(command: Callable[..., Any], code: str, values: tuple[str, str]) -> Diff:
    """Return the diff of runs of a main ``m:main`` with two values of a constant."""
    Path("job.yaml").write_text("nodes: [{main: 'm:main'}]\nstop: {duration: 500ms}\n")
    for name, value in zip("ab", values, strict=True):
        Path("m.py").write_text(f"CHANGE = {value}\n{code}")
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    return diff_files("a.mcap", "b.mcap")


def test_a_parameter_of_one_of_many_nodes_that_a_main_makes_is_of_that_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    found = record_both(command, _FACTORY, ("0.0", "10.0"))
    assert found.sentence.startswith("parameter gain of /item2 1.0 → 11.0 (code of module m); ")
    assert "first effect: /item2 published a different data on /count2" in found.sentence
    assert len(found.divergences) == 1


_DEADLINE = """
import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64
def main():
    rclpy.init()
    node = rclpy.create_node("source")
    events = PublisherEventCallbacks(deadline=lambda status: None)
    qos = QoSProfile(depth=1, deadline=Duration(nanoseconds=CHANGE * 1_000_000))
    out = node.create_publisher(Float64, "speed", qos, event_callbacks=events)
    for _ in range(3):
        out.publish(Float64())
        rclpy.spin_once(node, timeout_sec=0.2)
"""


def test_a_main_that_another_deadline_wakes_names_the_deadline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    found = record_both(command, _DEADLINE, ("100", "150"))
    assert found.sentence == (
        "the resumed main m:main ran at 0.1 s in a and at 0.15 s in b, 50 ms later; likely cause: "
        "/source created publisher /speed with a different QoS: deadline 100 → 150 ms"
    )


def test_of_a_package_that_a_workspace_has_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., Any]
) -> None:
    """As ``colcon build`` without ``--symlink-install`` leaves it."""
    site = tmp_path / "install/lib/python3/site-packages"
    files = {
        "install/share/ament_index/resource_index/packages/factory_bot": "",
        "install/lib/python3/site-packages/factory_bot/__init__.py": "",
        "install/lib/python3/site-packages/factory_bot-1.dist-info/METADATA": "Name: factory_bot\n",
        "install/lib/python3/site-packages/factory_bot-1.dist-info/entry_points.txt": (
            "[console_scripts]\nfactory = factory_bot.nodes:main\n"
        ),
        "jobs/job.yaml": "nodes: [{executable: factory_bot/factory}]\nstop: {duration: 500ms}\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    monkeypatch.syspath_prepend(site)
    monkeypatch.chdir(tmp_path / "jobs")
    for name, change in (("a", "0.0"), ("b", "10.0")):
        (site / "factory_bot/nodes.py").write_text(f"CHANGE = {change}\n{_FACTORY}")
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
        for module in ("factory_bot.nodes", "factory_bot"):
            sys.modules.pop(module, None)
    assert cause("a.mcap", "b.mcap") == ["code of module factory_bot.nodes"]
    assert "factory_bot.nodes" in command("replay", "a.mcap").stderr


_TUNED = """
import sys
from rclpy.node import Node
from std_msgs.msg import Float64
class Tuned(Node):
    def __init__(self):
        super().__init__("tuned")
        gain = self.declare_parameter("gain", 1.0).value
        out = self.create_publisher(Float64, "tuned", 10)
        self.create_timer(0.1, lambda: out.publish(Float64(data=gain + BIAS)))
"""


def test_of_the_content_of_a_parameter_file(
    tmp_path: Path, command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not if only its comments differ, nor if the parameters are the same."""
    (tmp_path / "tuned.py").write_text(_TUNED.replace("BIAS", "sys.hidden"))
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: tuned:Tuned, parameter_files: [p.yaml]}]\nstop: {duration: 500ms}\n"
    )
    text = "/**: {ros__parameters: {gain: %s, unused: %s}}%s\n"
    for name, values, hidden in (
        ("a", (1.5, 1, ""), 0.0),
        ("other", (2.5, 1, ""), 0.0),
        ("comment", (1.5, 1, "  # tuned"), 1.0),
        ("unused", (1.5, 2, ""), 1.0),
    ):
        (tmp_path / "p.yaml").write_text(text % values)
        monkeypatch.setattr(sys, "hidden", hidden, raising=False)
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    found = diff_files("a.mcap", "other.mcap")
    assert found.verdict is Verdict.ENVIRONMENT
    assert found.sentence.startswith(
        "parameter gain of /tuned 1.5 → 2.5 (file p.yaml); first effect: /tuned published"
    )
    assert [cause("a.mcap", f"{name}.mcap") for name in ("comment", "unused")] == [[], []]


def test_of_a_module_that_pythonpath_leads_to(
    package: Path, command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    (package / "tuned.py").write_text(_TUNED.replace("BIAS", "tables.BIAS"))
    (package / "tuned.py").write_text("import tables\n" + (package / "tuned.py").read_text())
    (package / "job.yaml").write_text("nodes: [{node: tuned:Tuned}]\nstop: {duration: 500ms}\n")
    for name in ("a", "b"):
        folder = package.parent / f"{package.name}_{name}"
        folder.mkdir()
        (folder / "tables.py").write_text(f"BIAS = {ord(name)}.0\n")
        with monkeypatch.context() as patched:
            patched.setenv("PYTHONPATH", str(folder))
            patched.syspath_prepend(folder)
            assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
        sys.modules.pop("tables", None)
    assert cause("a.mcap", "b.mcap") == ["code of module tables"]
    assert "tables" in command("replay", "a.mcap").stderr


_STARTS = """
import time
import rclpy
def main():
    rclpy.init()
    node = rclpy.create_node("starts")
    for _ in range(STEPS):
        time.sleep(0.1)
    node.create_timer(0.2, lambda: None)
    rclpy.spin(node)
"""


def test_a_main_that_spins_until_the_run_ends_does_not_sleep(
    tmp_path: Path, command: Callable[..., Any]
) -> None:
    (tmp_path / "job.yaml").write_text("nodes: [{main: starts:main}]\nstop: {duration: 500ms}\n")
    for name, steps in (("a", 2), ("b", 1)):
        (tmp_path / "starts.py").write_text(f"STEPS = {steps}\n{_STARTS}")
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    sentence = diff_files("a.mcap", "b.mcap").sentence
    assert "slept 100 ms in a but not in b" in sentence, sentence


_TYPED = """
import rclpy
from std_msgs.msg import String
def main():
    rclpy.init()
    out = rclpy.create_node("typed").create_publisher(String, "typed", 10)
    out.publish(String(data=input()))
"""


def test_of_what_is_typed(tmp_path: Path, command: Callable[..., Any]) -> None:
    (tmp_path / "typed.py").write_text(_TYPED)
    (tmp_path / "job.yaml").write_text("nodes: [{main: 'typed:main', stdin: typed.txt}]\n")
    for name in ("a", "b"):
        (tmp_path / "typed.txt").write_text(f"{name}\n")
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    assert cause("a.mcap", "b.mcap") == ["file typed.txt"]


def test_what_the_c_library_answers_is_a_possible_cause(
    tmp_path: Path, command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = "import ctypes\nread = ctypes.CDLL(None).getenv\nread.restype = ctypes.c_char_p\n"
    (tmp_path / "tuned.py").write_text(node + _TUNED.replace("BIAS", "len(read(b'FAULT'))"))
    (tmp_path / "job.yaml").write_text("nodes: [{node: tuned:Tuned}]\nstop: {duration: 500ms}\n")
    for name, value in (("a", "1"), ("b", "12")):
        monkeypatch.setenv("FAULT", value)
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    found = diff_files("a.mcap", "b.mcap")
    assert "; possible cause: the result of C library: getenv() at tuned.py:2" in found.sentence
    assert found.divergences[0].root_sentence.endswith("getenv() at tuned.py:2 is not recorded")


_DATABASE = "import sqlite3\n"
_FORKED = "os.fork() or os._exit(0)"
_READ = "sqlite3.connect(%s).execute('select v from w').fetchone()[0]"


def _write_database(path: Path, value: int) -> None:
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as made, made:
        made.execute("create table w (v)")
        made.execute("insert into w values (?)", (value,))


@pytest.mark.parametrize("name", ["'w.db'", "'file:w.db?mode=ro', uri=True"])
def test_a_database_is_a_file_that_was_read(
    tmp_path: Path, command: Callable[..., Any], name: str
) -> None:
    (tmp_path / "tuned.py").write_text(_DATABASE + _TUNED.replace("BIAS", _READ % name))
    (tmp_path / "job.yaml").write_text("nodes: [{node: tuned:Tuned}]\nstop: {duration: 500ms}\n")
    for trace, value in (("a", 1), ("b", 2)):
        _write_database(tmp_path / "w.db", value)
        assert command("record", "job.yaml", "-o", f"{trace}.mcap").returncode == 0
    found = diff_files("a.mcap", "b.mcap")
    assert "; likely cause: /tuned read w.db" in found.sentence, found.sentence


def test_a_database_in_use_is_not_read(tmp_path: Path, command: Callable[..., Any]) -> None:
    """To open and close the file would drop the locks of the node's other connection."""
    twice = "one, two = [sqlite3.connect('w.db').execute(sql) for sql in (INSERT, 'select 1')]\n"
    insert = f"{_DATABASE}INSERT = 'insert into w values (2)'\n"
    (tmp_path / "tuned.py").write_text(insert + twice + _TUNED.replace("BIAS", "1"))
    (tmp_path / "job.yaml").write_text("nodes: [{node: tuned:Tuned}]\nstop: {duration: 100ms}\n")
    _write_database(tmp_path / "w.db", 1)
    assert command("record", "job.yaml", "-o", "a.mcap").returncode == 0
    with Trace.open("a.mcap") as trace:
        values = [f.value for found in trace.answers.values() for f in found if "w.db" in f.call]
    assert [value.partition(", ")[0] for value in values] == ["8192 bytes", "in use"]


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (
            "signal.setitimer(signal.ITIMER_REAL, 0)",
            "signal.setitimer() at tuned.py:11, which comes",
        ),
        (_FORKED, "os.fork() at tuned.py:11, which is not recorded"),
    ],
    ids=["timer", "fork"],
)
def test_what_happens_in_real_time_is_a_possible_cause(
    tmp_path: Path,
    command: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
    call: str,
    told: str,
) -> None:
    node = "import os, signal\n" + _TUNED.replace("BIAS", f"FAULT + 0 * len([{call}])")
    (tmp_path / "tuned.py").write_text(node)
    (tmp_path / "job.yaml").write_text("nodes: [{node: tuned:Tuned}]\nstop: {duration: 100ms}\n")
    for name in ("a", "b"):
        monkeypatch.setattr("builtins.FAULT", "ab".index(name), raising=False)
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    found = diff_files("a.mcap", "b.mcap")
    assert f"; possible cause: the result of {told}" in found.sentence, found.sentence
    assert "{process: record}" not in found.divergences[0].root_sentence


def test_what_sqlite_draws_is_a_possible_cause(tmp_path: Path, command: Callable[..., Any]) -> None:
    drawn = "sqlite3.connect(':memory:').execute('select random()').fetchone()[0]"
    (tmp_path / "tuned.py").write_text(_DATABASE + _TUNED.replace("BIAS", drawn))
    (tmp_path / "job.yaml").write_text("nodes: [{node: tuned:Tuned}]\nstop: {duration: 500ms}\n")
    for name in ("a", "b"):
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    sentence = diff_files("a.mcap", "b.mcap").sentence
    assert "; possible cause: the result of SQLite: random() at tuned.py:" in sentence, sentence


_GOALS = """
from rclpy.action import ActionClient
from rclpy.node import Node
from test_msgs.action import Fibonacci
class Boss(Node):
    def __init__(self):
        super().__init__("boss")
        self.client = ActionClient(self, Fibonacci, "plan")
        self.create_timer(0.1, lambda: self.client.send_goal_async(Fibonacci.Goal(order=3)))
"""


def test_the_seed_is_the_cause_of_another_goal_id(
    tmp_path: Path, command: Callable[..., Any]
) -> None:
    """rclpy draws it, in no code of the user."""
    (tmp_path / "boss.py").write_text(_GOALS)
    (tmp_path / "job.yaml").write_text("nodes: [{node: boss:Boss}]\nstop: {duration: 100ms}\n")
    for seed in (1, 2):
        assert command("record", "job.yaml", "--seed", seed, "-o", f"{seed}.mcap").returncode == 0
    assert cause("1.mcap", "2.mcap") == ["seed"]


def test_the_next_step_makes_a_constructor_again(
    tmp_path: Path, command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    named = _TUNED.replace('"tuned", 10', 'os.environ["TOPIC"], 10').replace("BIAS", "1")
    (tmp_path / "tuned.py").write_text("import os\n" + named)
    (tmp_path / "job.yaml").write_text("nodes: [{node: tuned:Tuned}]\nstop: {duration: 500ms}\n")
    for name in ("a", "b"):
        monkeypatch.setenv("TOPIC", name)
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    steps = diff_files("a.mcap", "b.mcap").divergences[0].next_step.split("; ")
    assert all(command(*step.split()[1:]).returncode == 0 for step in steps)
    assert "reproduces b" in command(*steps[1].split()[1:]).stdout


_WAITS = """
import os, time
import rclpy
def main():
    rclpy.init()
    node = rclpy.create_node("waits")
    time.sleep(float(os.environ["WAIT"]))
"""


def test_what_a_main_read_once_it_had_a_node(
    tmp_path: Path, command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "waits.py").write_text(_WAITS)
    (tmp_path / "job.yaml").write_text("nodes: [{main: waits:main}]\nstop: {duration: 500ms}\n")
    for name, seconds in (("a", "0.1"), ("b", "0.2")):
        monkeypatch.setenv("WAIT", seconds)
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
    sentence = diff_files("a.mcap", "b.mcap").sentence
    assert "read WAIT (0.1 in a, 0.2 in b) at waits.py:7" in sentence, sentence
