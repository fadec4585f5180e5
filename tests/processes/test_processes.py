"""Executables in processes of their own, in the same run as nodes of this process."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import std_msgs.msg
from rosidl_parser.definition import BasicType

import rsltrace
from rsltrace.adapters.processes.build import PreloadLibrary, find_ros, program
from rsltrace.adapters.rclpy.messages.interface_classes import forget_interfaces
from rsltrace.diff import diff_files
from rsltrace.errors import JobError, SetupError
from rsltrace.job import load_job
from rsltrace.run import run, watchdog
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros
long = pytest.mark.long

ECHO = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt64

class Echo(Node):
    def __init__(self):
        super().__init__('echo')
        self.publisher = self.create_publisher(UInt64, 'echo', 10)
        self.create_subscription(UInt64, 'count', self.publisher.publish, 10)
        self.create_subscription(UInt64, 'heard', self.heard, 10)

    def heard(self, message):
        now = self.get_clock().now().nanoseconds
        self.get_logger().info(f'{message.data} at {now}')

def main():
    rclpy.init()
    rclpy.spin(Echo())

if __name__ == '__main__':
    main()
"""
BUSY = """
import os
import rclpy

rclpy.init()
node = rclpy.create_node('busy')

def look():
    while not os.path.exists({told!r}):
        pass

node.create_timer(0.5, look)
rclpy.spin(node)
"""
Compiled = Callable[[str], Path]


@pytest.fixture
def counter(compiled: Compiled, tmp_path: Path) -> Path:
    """The C node, beside a Python file that answers it."""
    (tmp_path / "echo_node.py").write_text(ECHO)
    return compiled("counter.c")


JOB = """
search_path: [.]
nodes:
  - program: {program}
    arguments: [{arguments}]
    on_exception: {on_exception}
  - {echo}
stop: {{duration: 1s}}
"""


def _job(
    folder: Path,
    program: Path,
    *arguments: str,
    echo: str = "node: echo_node:Echo",
    on_exception: str = "stop",
    more: str = "",
) -> rsltrace.Job:
    text = JOB.format(
        program=program, arguments=", ".join(arguments), echo=echo, on_exception=on_exception
    )
    (folder / "job.yaml").write_text(text + more)
    return load_job(folder / "job.yaml")


def _said(path: Path, *topics: str) -> dict[str, list[tuple[int, bytes]]]:
    """Return (stamp, canonical bytes) of all messages of some topics."""
    with Trace.open(path) as trace:
        return {
            topic: [(stamp, bytes(data)) for stamp, _, data in trace.messages(topic)]
            for topic in topics
        }


def _logs(path: Path) -> list[tuple[int, str]]:
    with Trace.open(path) as trace:
        decoded = (
            (stamp, trace.decode("/rosout", data)) for stamp, _, data in trace.messages("/rosout")
        )
        return [(stamp, record.msg) for stamp, record in decoded]  # type: ignore[attr-defined]


@pytest.mark.long
def test_callbacks_of_a_process_take_the_time_that_the_job_gives_them(
    counter: Path, tmp_path: Path
) -> None:
    more = "policy: permutation\nexecution: {nodes: {/counter: 10ms}}\n"
    results = [
        run(_job(tmp_path, counter, "'50'", more=more), tmp_path / f"{n}.mcap") for n in range(2)
    ]
    assert results[0].digest == results[1].digest
    assert [stamp for stamp, _ in _logs(tmp_path / "0.mcap")[:2]] == [70_000_000, 120_000_000]


def _number(count: int) -> bytes:
    return b"\0\1\0\0" + count.to_bytes(8, "little")


def test_a_c_program_and_a_node_of_this_process_are_in_one_run_and_each_run_is_the_same(
    counter: Path, tmp_path: Path
) -> None:
    job = _job(tmp_path, counter, "'50'")
    results = [run(job, tmp_path / f"{n}.mcap") for n in range(2)]
    assert [result.error for result in results] == [None, None]
    assert results[0].digest == results[1].digest
    assert results[0].stop_reason.startswith("duration")
    said = _said(tmp_path / "0.mcap", "/count", "/echo", "/heard")
    expected = [(50_000_000 * n, _number(n)) for n in range(1, 21)]
    assert said == {"/count": expected, "/echo": expected, "/heard": expected}
    assert _logs(tmp_path / "0.mcap") == [(t, f"{t // 50_000_000} at {t}") for t, _ in expected]
    with Trace.open(tmp_path / "0.mcap") as trace:
        heard = next(e for e in trace.entities.values() if e.name == "/echo" and e.node == 4)
        events = [trace.event(i) for i in range(trace.event_count)]
        first = next(event for event in events if event.entity == heard.id)
        assert first.kind is EventKind.SUBSCRIPTION
        assert events[first.cause_event].kind is EventKind.SUBSCRIPTION  # echo's own callback


@pytest.mark.long
def test_an_isolated_script_says_what_it_says_in_this_process(
    counter: Path, tmp_path: Path
) -> None:
    said = []
    for name, more in (("here", ""), ("beside", "\n    isolated: true")):
        job = _job(tmp_path, counter, echo=f"script: echo_node.py{more}")
        assert run(job, tmp_path / f"{name}.mcap").error is None
        path = tmp_path / f"{name}.mcap"
        said.append((_said(path, "/count", "/echo", "/heard"), _logs(path)))
    assert said[0] == said[1]
    assert len(said[0][1]) == 10


@long
def test_a_link_delays_what_goes_to_a_process(counter: Path, tmp_path: Path) -> None:
    job = _job(tmp_path, counter, more="delay: {default: 5ms}\n")
    assert run(job, tmp_path / "t.mcap").error is None
    said = _said(tmp_path / "t.mcap", "/count", "/echo", "/heard")
    assert said["/echo"][0] == (105_000_000, _number(1))
    assert said["/heard"][0] == (110_000_000, _number(1))


@pytest.mark.parametrize(
    ("action", "ending"),
    [
        ("crash", "was killed by SIGSEGV at 0.500000000 s"),
        pytest.param("kill", "was killed by SIGKILL at 0.500000000 s", marks=long),
        pytest.param("exit", "ended with exit status 7 at 0.500000000 s", marks=long),
        (
            "write",
            "wrote something of its own to the descriptor by which rsltrace runs it at "
            "0.500000000 s",
        ),
        pytest.param(
            "exec", "closed the descriptor by which rsltrace runs it at 0.500000000 s", marks=long
        ),
        pytest.param(
            "close", "closed the descriptor by which rsltrace runs it at 0.500000000 s", marks=long
        ),
    ],
)
def test_a_process_that_fails_ends_the_run_and_is_named_with_its_last_callback(
    counter: Path, tmp_path: Path, action: str, ending: str
) -> None:
    result = run(_job(tmp_path, counter, "'100'", action), tmp_path / "t.mcap")
    assert str(result.error) == (
        f"process {counter} {ending}; the last that it ran was /counter: timer timer 1"
    )
    assert result.stop_reason == str(result.error)
    assert result.exit_code == 3
    with Trace.open(tmp_path / "t.mcap") as trace:
        assert trace.complete
        last = trace.event(result.events - 1)
    assert (last.kind, last.stamp_ns) == (EventKind.TIMER, 500_000_000)
    # What it said in that callback counts, unless it has written over it.
    counted = len(_said(tmp_path / "t.mcap", "/count")["/count"])
    assert counted == (4 if action == "write" else 5)
    _no_process_of(counter)


def test_a_deadlock_is_noted_once(counter: Path, tmp_path: Path) -> None:
    """The signal at the end of the run wakes the process, which then waits for the same again."""
    result = run(_job(tmp_path, counter, "'100'", "lock"), tmp_path / "t.mcap")
    (note,) = (note for note in result.notes if "deadlock, unless a signal comes" in note)
    assert re.search(r"^ +.*counter\.c:\d+ in main$", note, re.MULTILINE), note


def test_a_class_that_rosidl_did_not_generate_is_named(
    counter: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package of that name hides the real one, or was written by hand."""
    odd = type("UInt64", (), {"SLOT_TYPES": (), "__module__": "std_msgs.msg"})
    monkeypatch.setattr(std_msgs.msg, "UInt64", odd)
    forget_interfaces()
    try:
        result = run(_job(tmp_path, counter), tmp_path / "t.mcap")
    finally:
        forget_interfaces()
    said, who = str(result.error).splitlines()
    assert said == (
        "a process uses std_msgs/msg/UInt64, whose class in Python (std_msgs.msg.UInt64 in "
        f"{std_msgs.msg.__file__}) was not generated by rosidl: build the package and source its "
        "workspace, or move away what hides it"
    )
    assert who == f"  in {counter}, at simulated time 0.000000000 s"
    assert result.exit_code == 3
    _no_process_of(counter)


def test_a_type_with_a_field_that_python_does_not_have_is_known_by_name(
    counter: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """C and C++ have ``wchar`` and ``long double``, rclpy does not."""
    fields = {
        "SLOT_TYPES": (BasicType("long double"),),
        "_fields_and_field_types": {"data": "long double"},
    }
    odd = type("UInt64", (), {**fields, "__module__": "std_msgs.msg._u_int64"})
    monkeypatch.setattr(std_msgs.msg, "UInt64", odd)
    forget_interfaces()
    try:
        job = load_job(_job(tmp_path, counter).source_name, overrides=["nodes.1=null"])
        result = run(job, tmp_path / "t.mcap")
    finally:
        forget_interfaces()
    assert result.error is None
    with Trace.open(tmp_path / "t.mcap") as trace:
        assert len(list(trace.messages("/count"))) == 10
        channel = next(one for one in trace.channels.values() if one.topic == "/count")
        assert (channel.type, channel.schema_text) == ("std_msgs/msg/UInt64", "")


@long
def test_a_script_that_another_program_takes_the_place_of_is_named(tmp_path: Path) -> None:
    """That program, Python here, is none of the run's, and runs as if there were none."""
    script = tmp_path / "start.sh"
    script.write_text(f"#!/bin/sh\nexec {sys.executable} -c 'import time; time.sleep(60)'\n")
    script.chmod(0o755)
    (tmp_path / "job.yaml").write_text("nodes: [{program: start.sh}]\nstop: {duration: 1s}\n")
    result = run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap")
    assert "closed the descriptor by which rsltrace runs it" in str(result.error)
    assert result.exit_code == 3


@long
def test_a_process_that_does_not_come_back_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = tmp_path / "told"
    (tmp_path / "busy.py").write_text(BUSY.format(told=str(told)))
    job = "nodes: [{script: busy.py, isolated: true}]\nstop: {duration: 1s}\n"
    (tmp_path / "job.yaml").write_text(job)
    notes: list[str] = []

    def say(text: str) -> None:
        notes.append(text)
        if "/busy" in text:  # not of a start that a busy machine makes slow
            told.touch()

    monkeypatch.setattr(watchdog, "LOOK_EVERY_S", 0.2)
    monkeypatch.setattr(watchdog, "tell", say)
    assert run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap").error is None
    note = next(note for note in notes if "/busy" in note)
    pattern = r"rsltrace: note: process \S*busy\S* \(pid \d+\), in /busy: timer timer 1, has "
    assert re.match(pattern, note)
    assert "stands still at 0.500000000 s. Ctrl-C" in note


def test_a_run_goes_on_without_a_process_if_the_job_says_so(counter: Path, tmp_path: Path) -> None:
    job = _job(tmp_path, counter, "'100'", "crash", on_exception="log")
    result = run(job, tmp_path / "t.mcap")
    assert result.error is None
    assert result.exit_code == 1
    assert len(_said(tmp_path / "t.mcap", "/count")["/count"]) == 5


@long
@pytest.mark.parametrize(("action", "counted"), [("leave", 5), ("fork", 10)])
def test_a_process_may_end_or_start_others(
    counter: Path, tmp_path: Path, action: str, counted: int
) -> None:
    result = run(_job(tmp_path, counter, "'100'", action), tmp_path / "t.mcap")
    assert (result.error, result.exit_code) == (None, 0)
    ended = [note for note in result.notes if note.endswith("counter ended at 0.500000000 s")]
    assert len(ended) == (action == "leave"), result.notes
    assert len(_said(tmp_path / "t.mcap", "/count")["/count"]) == counted
    _no_process_of(counter)


LARGE = """
import sys
import rclpy
from std_msgs.msg import UInt8MultiArray

rclpy.init()
node = rclpy.create_node(sys.argv[1])
out = node.create_publisher(UInt8MultiArray, sys.argv[1], 10)
if sys.argv[1] == 'asked':
    sizes = [10, 20_000, 3_000_000, 70_000, 0, 9_000_000]
    def ask():
        if sizes:
            size = sizes.pop(0)
            out.publish(UInt8MultiArray(data=(bytes(range(256)) * (size // 256 + 1))[:size]))
    node.create_timer(0.1, ask)
else:
    node.create_subscription(UInt8MultiArray, 'asked', out.publish, 10)
rclpy.spin(node)
"""


@long
def test_large_messages_arrive_as_they_were_sent(compiled: Compiled, tmp_path: Path) -> None:
    (tmp_path / "large.py").write_text(LARGE)
    entries = "".join(
        f"  - {{script: large.py, isolated: true, arguments: [{name}]}}\n"
        for name in ("answered", "asked")
    )
    (tmp_path / "job.yaml").write_text(f"nodes:\n{entries}stop: {{duration: 1s}}\n")
    assert run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap").error is None
    said = _said(tmp_path / "t.mcap", "/asked", "/answered")
    assert said["/asked"] == said["/answered"]
    assert [len(data) - 16 for _, data in said["/asked"]] == [
        10, 20_000, 3_000_000, 70_000, 0, 9_000_000
    ]  # fmt: skip


def _no_process_of(program: Path) -> None:
    """Fail unless every process of a program ends soon: the kernel needs a moment."""
    deadline = time.monotonic() + 600
    while _processes_of(program):
        assert time.monotonic() < deadline, "a process was left behind"
        time.sleep(0.02)


def _processes_of(program: Path) -> list[int]:
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError):
                if os.readlink(folder / "exe") == str(program):
                    found.append(int(folder.name))
    return found


def test_no_process_outlives_a_run_that_is_killed(counter: Path, tmp_path: Path) -> None:
    _job(tmp_path, counter, "'100'", "hang")
    command = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", "t.mcap"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL) as started:
        deadline = time.monotonic() + 600
        while not _processes_of(counter):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        started.send_signal(signal.SIGKILL)
    _no_process_of(counter)


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("node: echo_node:Echo\n    isolated: true", "a 'node' is a part of a program"),
        ("node: echo_node:Echo\n    environment: {A: b}", "only a process has an environment"),
        ("program: nowhere", "there is no such file"),
        ("program: echo_node.py\n    stdin: [yes]", "a process has no terminal in a run"),
    ],
)
def test_entries_that_cannot_be_processes_are_refused(
    tmp_path: Path, entry: str, expected: str
) -> None:
    (tmp_path / "echo_node.py").write_text(ECHO)
    (tmp_path / "job.yaml").write_text(f"nodes:\n  - {entry}\n")
    with pytest.raises(JobError, match=expected):
        load_job(tmp_path / "job.yaml")


def test_without_a_compiler_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "echo_node.py").write_text(ECHO)
    (tmp_path / "job.yaml").write_text("nodes:\n  - script: echo_node.py\n    isolated: true\n")
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(
        JobError, match=r"job.yaml:2:13: .*need a C\+\+ compiler.*apt install g\+\+"
    ):
        run(load_job(tmp_path / "job.yaml"), None)


def test_without_headers_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.prefix", str(tmp_path))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    with pytest.raises(SetupError, match="need ROS 2 with its headers"):
        find_ros()


@long
def test_a_message_that_a_process_receives_can_be_edited(counter: Path, tmp_path: Path) -> None:
    run(_job(tmp_path, counter), tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as trace:
        found = (trace.event(index) for index in range(trace.event_count))
        at = [
            event.index
            for event in found
            if event.kind is EventKind.SUBSCRIPTION and trace.entity(event.entity).name == "/echo"
        ][3]
    edits = [f"{at}: message.data += 100"]
    rsltrace.replay(tmp_path / "run.mcap", edits=edits, output=tmp_path / "b.mcap", trust=True)
    heard = [
        data
        for name in ("run", "b")
        for _, data in _said(tmp_path / f"{name}.mcap", "/heard")["/heard"]
    ]
    numbers = [int.from_bytes(data[4:12], "little") for data in heard]
    half = len(numbers) // 2
    assert numbers[half:] == [*numbers[:3], numbers[3] + 100, *numbers[4:half]]
    again = rsltrace.replay(tmp_path / "b.mcap", trust=True)
    assert again.is_whole, again.sentence


def test_of_many_draws_the_first_and_the_last_are_in_the_trace(
    counter: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, more in (("a", "0"), ("b", "1")):
        (tmp_path / "more").write_text(more)
        run(_job(tmp_path, counter, "'100'", "rand"), tmp_path / f"{name}.mcap")
    with Trace.open(tmp_path / "a.mcap") as trace:
        (draws,) = (met for met in trace.guarded if met.call == "rand()")
        drawn = Counter(
            one.event for found in trace.answers.values() for one in found if one.call == "rand()"
        )
    assert draws.count == sum(90 + count for count in range(1, 11))
    assert [*drawn.values()] == [5] * 10
    (first,) = diff_files(tmp_path / "a.mcap", tmp_path / "b.mcap").divergences[:1]
    assert re.search(
        r"/counter drew rand\(\) \(call 91: \d+ in a, call 92: \d+ in b\)", first.root_sentence
    )


def test_a_variable_that_a_program_reads_is_the_cause(
    counter: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, value in (("a", "7"), ("b", "8"), ("c", "7" + " " * 1000)):
        monkeypatch.setenv("COUNT_FROM", value)
        run(_job(tmp_path, counter), tmp_path / f"{name}.mcap")
        run(_job(tmp_path, counter, "'100'", "heap"), tmp_path / f"heap_{name}.mcap")
    (first,) = diff_files(tmp_path / "a.mcap", tmp_path / "b.mcap").divergences[:1]
    assert "/counter read COUNT_FROM (7 in a, 8 in b)" in first.root_sentence
    short, long = (_said(tmp_path / f"heap_{name}.mcap", "/count") for name in "ac")
    assert short == long  # how long a value is does not show in addresses


def test_a_diff_does_not_advise_to_record_the_state_of_a_process(
    counter: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        (tmp_path / "more").write_text(str(ord(name)))  # which no trace has
        run(_job(tmp_path, counter), tmp_path / f"{name}.mcap")
    (first,) = diff_files(tmp_path / "a.mcap", tmp_path / "b.mcap").divergences[:1]
    assert "/counter" in first.sentence
    assert first.root_sentence.endswith("itself is not deterministic")


def test_a_process_finds_the_libraries_of_the_prefixes_that_are_sourced(tmp_path: Path) -> None:
    for name in ("has", "known", "has_none"):
        (tmp_path / name / "lib").mkdir(parents=True)
    for name in ("has", "known"):
        (tmp_path / name / "lib" / "libmine.so").touch()
    prefixes = ":".join(str(tmp_path / name) for name in ("has", "known", "has_none"))
    around = {"AMENT_PREFIX_PATH": prefixes, "LD_LIBRARY_PATH": f"{tmp_path}/known/lib"}
    preload = PreloadLibrary(tmp_path / "a.so", find_ros())
    made = program(
        [sys.executable], preload, surroundings=around, environment={}, folder=None
    ).environment
    found = made["LD_LIBRARY_PATH"].split(":")
    assert found[-2:] == [f"{tmp_path}/known/lib", f"{tmp_path}/has/lib"]


def test_a_debugging_session_lists_the_nodes_of_processes(counter: Path, tmp_path: Path) -> None:
    _job(tmp_path, counter)
    with rsltrace.DebugSession(tmp_path / "job.yaml") as session:
        session.run_to("0.2s")
        kinds = {one["name"]: one["class"] for one in session.inspect("nodes")}
        (process,) = session.inspect("processes")
    assert kinds["/counter"] == f"in process {process['pid']}"
    assert kinds["/echo"] == "echo_node.Echo"
