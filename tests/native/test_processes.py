"""Native runs with a process for each entry: nothing is lost, and the causes are right."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from rsltrace.errors import RsltraceError
from rsltrace.trace.contents import check_contents
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.timings import callback_figures, timings
from tests.native.running import (
    COMMAND,
    PATIENCE_S,
    ROBOT,
    environment,
    events_of,
    job,
    record,
    wait_until,
)
from tests.processes.conftest import compiled

__all__ = ["compiled"]

pytestmark = [
    pytest.mark.ros,
    pytest.mark.native,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs rclpy"),
]

FOUR = """
nodes:
  - {main: robot_mains:count, arguments: [a], name: a, parameters: {first: 100000}}
  - {main: robot_mains:count, arguments: [b], name: b, parameters: {first: 200000}}
  - {main: robot_mains:count, arguments: [c], name: c, parameters: {first: 300000, period: 0.013}}
  - {main: robot_mains:count, arguments: [d], name: d, parameters: {first: 400000, period: 0.1}}
stop: {function: robot_mains:all_heard, timeout: 300s}
"""


IN_C = """
nodes:
  - {main: robot_mains:count, arguments: [a], name: a, parameters: {first: 100000}}
  - {program: PROGRAM, arguments: [b, "200000", "10"], name: b}
  - {program: PROGRAM, arguments: [c, "300000", "13"], name: c}
  - {main: robot_mains:count, arguments: [d], name: d, parameters: {first: 400000, period: 0.1}}
stop: {function: robot_mains:all_heard, timeout: 300s}
"""


@pytest.fixture(scope="module", params=[FOUR, IN_C], ids=["Python", "C"])
def four(
    tmp_path_factory: pytest.TempPathFactory,
    request: pytest.FixtureRequest,
    compiled: Callable[[str], Path],
) -> Iterator[tuple[Trace, dict[str, Any]]]:
    """A run of four processes, which all hear each other, and what they counted themselves."""
    folder = tmp_path_factory.mktemp("four")
    text = request.param
    if "PROGRAM" in text:
        text = text.replace("PROGRAM", str(compiled("../native/counting.c")))
    done = record(folder, text)
    assert done.returncode == 0, done.stderr
    counted = {name: json.loads((folder / name).read_text()) for name in "abcd"}
    with Trace.open(folder / "run.mcap") as trace:
        yield trace, counted


@pytest.mark.long
def test_messages_of_threads_that_share_a_publisher_have_their_causes(
    tmp_path: Path, compiled: Callable[[str], Path]
) -> None:
    program = compiled("../native/counting.c")
    done = record(
        tmp_path,
        f"nodes: [{{program: {program}, arguments: [a, '1', '10', threads]}}]\n"
        "stop: {duration: 3s}\n",
    )
    assert done.returncode == 0, done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert trace.result["unknown_causes"] == "0"


def callbacks(trace: Trace, node: str, name: str, kind: EventKind) -> list[Any]:
    """Return the events of one entity of a node."""
    (entity,) = [
        one.id
        for one in trace.entities.values()
        if one.name == name and trace.node_of(one).name == f"/{node}" and one.id != one.node
        if one.kind is (EntityKind.TIMER if kind is EventKind.TIMER else EntityKind.SUBSCRIPTION)
    ]
    return [e for e in events_of(trace) if e.entity == entity and e.kind is kind]


def test_nothing_that_the_nodes_counted_is_missing(four: tuple[Trace, dict[str, Any]]) -> None:
    trace, counted = four
    trace.check()
    check_contents(trace)
    assert trace.metadata("rsltrace:native")["processes"] == "4"
    for name, own in counted.items():
        ran = {
            "sent": callbacks(trace, name, "Counting.on_timer", EventKind.TIMER),
            "got": callbacks(trace, name, "/numbers", EventKind.SUBSCRIPTION),
            "same": callbacks(trace, name, "/same", EventKind.SUBSCRIPTION),
        }
        own_counts = {**own, "got": len(own["got"])}
        # The stop interrupts a process as Ctrl-C does: one callback may end before it has counted.
        cut = [e for events in ran.values() for e in events if e.flags & EventFlag.RAISED]
        assert len(cut) <= 1
        for what, events in ran.items():
            assert len(events) - own_counts[what] in {0, sum(e in cut for e in events)}
            assert not any(e in cut for e in events[:-1])
        assert own["sent"] > 20
        assert {number // 100000 for number in own["got"]} == {1, 2, 3, 4}


def test_every_message_has_its_cause(four: tuple[Trace, dict[str, Any]]) -> None:
    trace, counted = four
    for name, own in counted.items():
        heard = callbacks(trace, name, "/numbers", EventKind.SUBSCRIPTION)
        # The callback that the stop interrupts may not have counted: the test above allows one.
        for event, number in zip(heard[: len(own["got"])], own["got"], strict=True):
            assert event.cause_event < event.index
            output = trace.outputs_of(event.cause_event)[event.cause_output]
            payload = trace.payload(output)
            assert payload is not None
            assert trace.decode("/numbers", payload[2]).data == number  # type: ignore[attr-defined]
    assert trace.result["unknown_causes"] == "0"


def test_equal_messages_of_four_publishers_are_told_apart(
    four: tuple[Trace, dict[str, Any]],
) -> None:
    """Whoever has heard one of a publisher gets all that follow, each once and from its number."""
    trace, counted = four
    rows = timings(trace)
    numbers: dict[int, dict[tuple[int, int], int]] = defaultdict(dict)
    for event in events_of(trace):
        for place, output in enumerate(trace.outputs_of(event.index)):
            if output.kind == 1 and trace.entity(output.entity).name == "/same":
                own = numbers[output.entity]
                own[event.index, place] = len(own) + 1
    assert len(numbers) == 4
    for name in counted:
        by_sender: dict[int, list[int]] = defaultdict(list)
        for event in callbacks(trace, name, "/same", EventKind.SUBSCRIPTION):
            output = trace.outputs_of(event.cause_event)[event.cause_output]
            number = numbers[output.entity][event.cause_event, event.cause_output]
            assert int(rows[event.index]["sequence"]) == number
            cause, row = rows[event.cause_event], rows[event.index]
            assert cause["wall"] <= row["source"] <= cause["wall"] + cause["duration"]
            by_sender[output.entity].append(number)
        assert len(by_sender) == 4
        for heard in by_sender.values():
            assert heard == list(range(heard[0], heard[0] + len(heard)))


def test_times_are_in_order_and_threads_are_not_mixed_up(
    four: tuple[Trace, dict[str, Any]],
) -> None:
    trace, counted = four
    rows = timings(trace)
    assert (rows["steady"][1:] >= rows["steady"][:-1]).all()
    threads = defaultdict(set)
    for event in events_of(trace):
        node = trace.node_of(trace.entity(event.entity)).name
        threads[node].add(int(rows[event.index]["thread"]))
    own = [threads[f"/{name}"] for name in counted]
    assert all(own)
    assert sum(map(len, own)) == len(set.union(*own))
    lost = [one.lost for one in callback_figures(trace) if one.lost is not None]
    assert len(lost) == 8
    assert not any(lost)


def test_nodes_of_all_kinds_run_in_processes_of_their_own(tmp_path: Path) -> None:
    text = """
nodes:
  - {node: robot:Talker, name: fast, parameters: {period: 0.01}}
  - {node: robot:Listener, remappings: {/echo: /heard}, start_after: {topic: /same}}
  - node: robot:Server
  - {node: robot:Nested, remappings: {/done: /nested}, start_after: {topic: /heard}}
  - {node: robot:Asker, start_after: {topic: /nested}}
  - {main: robot_mains:talk, arguments: [5], start_after: {service: /ask, delay: 200ms}}
  - main: robot_mains:talk
    arguments: [3]
    name: last
    start_after: {ended: 5, topic: /done}
    required: true
stop: {timeout: 300s}
"""
    done = record(tmp_path, text, "--processes", "--executor", "multi")
    assert done.returncode == 0, done.stderr
    assert "talk ended at" in done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        assert "which the run requires" in trace.result["stop_reason"]
        events = events_of(trace)
        met = {(trace.entity(e.entity).name, e.kind) for e in events}
        assert {
            ("Talker.on_timer", EventKind.TIMER),
            ("/same", EventKind.SUBSCRIPTION),
            ("/ask", EventKind.SERVICE),
            ("/ask", EventKind.CLIENT),
            ("/count/_action/send_goal", EventKind.ACTION),
            ("Nested.on_timer", EventKind.RESUME),
            ("robot_mains:talk", EventKind.RESUME),
            ("/listener", EventKind.SHUTDOWN),
        } <= met
        for event in events:
            if event.kind in (EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT):
                assert event.cause_event != NO_EVENT, trace.entity(event.entity)
        made = {e.name: e.created_ns for e in trace.entities.values() if e.kind is EntityKind.NODE}
        sent = Counter(
            trace.node_of(trace.entity(output.entity)).name
            for event in events
            for output in trace.outputs_of(event.index)
            if output.kind == 1 and trace.entity(output.entity).name == "/numbers"
        )
        assert (sent["/talk"], sent["/last"]) == (5, 3)
        assert made["/server"] + 200_000_000 <= made["/talk"] < made["/last"]


def test_what_a_program_does_is_known_while_it_runs(
    tmp_path: Path, compiled: Callable[[str], Path]
) -> None:
    program = f"{{program: {compiled('counter.c')}, arguments: ['100']}}"
    later = "{node: robot:Talker, start_after: {topic: /count}}"
    done = record(tmp_path, f"nodes: [{program}, {later}]\nstop: {{topic: /same, timeout: 300s}}\n")
    assert done.returncode == 0, done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert "/same" in trace.result["stop_reason"]


_UNBUILT = """
from rclpy.node import Node

from rsltrace.errors import SetupError


def main():  # as creating a publisher does
    raise SetupError("arm in src/arm has not been built")


class Talker(Node):
    def __init__(self):
        super().__init__("talker")
        main()
"""


def test_a_program_that_fails_is_an_error(tmp_path: Path, command: Any) -> None:
    program = tmp_path / "fails.sh"
    program.write_text("#!/bin/sh\necho no such symbol >&2\nexit 127\n")
    program.chmod(0o755)
    done = command("record", "--native", "-o", "x.mcap", "--", "./fails.sh")
    assert done.returncode == 3
    assert "./fails.sh ended with exit status 127, " in done.stderr


@pytest.mark.parametrize("words", [(), ("--processes",)])
def test_interfaces_without_type_support_are_an_error_without_a_traceback(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    (tmp_path / "unbuilt.py").write_text(_UNBUILT)
    for spec, where in (("node", "constructing unbuilt:Talker"), ("main", "unbuilt:main")):
        text = f"nodes: [{{{spec}: unbuilt:{'Talker' if spec == 'node' else 'main'}}}]\n"
        done = record(tmp_path, text, "--until", "1", "--set", "search_path.+=.", "--force", *words)
        assert done.returncode == 3
        said = f"rsltrace: error: {where}: arm in src/arm has not been built\n"
        assert said in done.stderr
        assert "Traceback" not in done.stderr
        assert "SetupError" not in done.stderr


def test_other_programs_of_a_launch_file_run_and_what_they_start_is_observed(
    tmp_path: Path, command: Any
) -> None:
    """The shell starts Python: the first of it is a node, the others are told to end by the end."""
    others = "until test -s said && test -e trapped; do sleep 0.1; done"  # they have come so far
    node = f"{others}; {sys.executable} -c 'import robot_mains; robot_mains.talk()' 5"
    (tmp_path / "a.launch.py").write_text(f"""
from launch import LaunchDescription
from launch.actions import ExecuteProcess, Shutdown

def generate_launch_description():
    return LaunchDescription([
        ExecuteProcess(cmd=[{node!r}], shell=True, on_exit=Shutdown(),
                       additional_env={{"PYTHONPATH": {str(ROBOT)!r}}}),
        ExecuteProcess(cmd=["sh", "-c", 'echo "$1" > said; sleep 1000', "sh", "a  b"]),
        ExecuteProcess(cmd=["sh", "-c", "trap '' INT; touch trapped; while :; do sleep 1; done"]),
    ])
""")
    done = command("record", "--native", "--launch", "a.launch.py", "-o", "run.mcap")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "said").read_text() == "a  b\n"
    assert "sh, told to end, was killed by SIGTERM" in done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert trace.result["stop_reason"] == "/bin/sh has ended, which the run requires"
        sent = [trace.decode("/numbers", data).data for _, _, data in trace.messages("/numbers")]  # type: ignore[attr-defined]
        assert sent == [0, 1, 2, 3, 4]


def test_a_bag_is_played_in_real_time(tmp_path: Path, command: Any) -> None:
    made = "nodes: [{node: robot:Talker}]\nstop: {duration: 1s}\n"
    assert (
        command("record", job(tmp_path, made), "-o", "x.mcap", "--export-bag", "bag").returncode
        == 0
    )
    text = "nodes: [{node: robot:Listener}]\nbags: [{path: bag, topics: [/numbers, /same]}]\n"
    simulated = command("record", job(tmp_path, text), "-o", "simulated.mcap")
    assert simulated.returncode == 0, simulated.stderr
    done = record(tmp_path, text.replace("Listener", "LateListener"))
    assert done.returncode == 0, done.stderr
    simulation = Trace.open(tmp_path / "simulated.mcap")
    with Trace.open(tmp_path / "run.mcap") as trace, simulation as planned:
        assert trace.result["stop_reason"] == "end of the bag"
        assert trace.end_ns - trace.start_ns > 900_000_000
        heard = callbacks(trace, "listener", "/numbers", EventKind.SUBSCRIPTION)
        assert len(heard) == len(callbacks(planned, "listener", "/numbers", EventKind.SUBSCRIPTION))
        assert all(event.cause_event != NO_EVENT for event in heard)
    same = command("diff", "run.mcap", "simulated.mcap", "--topic", "/numbers")
    assert same.returncode == 3, same.stdout


@pytest.mark.parametrize(
    ("main", "said"),
    [
        ("crash", "rsltrace: error: robot_mains:crash was killed by SIGSEGV, "),
        ("fail", "rsltrace: error: robot_mains:fail raised ValueError: of the main"),
    ],
)
def test_a_process_that_fails_is_named_and_the_trace_is_kept(
    main: str, said: str, tmp_path: Path
) -> None:
    later = "{node: robot:Talker, start_after: {topic: /last_words}}"  # the trace will have them
    text = f"nodes: [{{main: robot_mains:{main}}}, {later}]\nstop: {{timeout: 300s}}"
    done = record(tmp_path, text)
    assert done.returncode == 3
    assert said in done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        assert trace.result["exit_code"] == "3"
        assert f"/{main}" in {entity.name for entity in trace.entities.values()}
        if main == "crash":
            (words,) = [e.id for e in trace.entities.values() if e.name == "/last_words"]
            outputs = [o for e in events_of(trace) for o in trace.outputs_of(e.index)]
            assert words in {output.entity for output in outputs if output.kind == 1}


@pytest.mark.parametrize("where", ["spin", "destroy", "shutdown", "exit"])
def test_all_that_a_main_has_done_that_crashes_at_its_end_is_kept(
    where: str, tmp_path: Path
) -> None:
    nodes = [
        f"  - {{main: robot_mains:crash_at_end, arguments: [{n}, {where}], on_exception: log}}\n"
        for n in range(1, 5)
    ]
    stop = "stop: {function: robot_mains:all_heard, timeout: 300s}\n"
    done = record(tmp_path, f"nodes:\n{''.join(nodes)}{stop}")
    assert done.returncode == 0, done.stderr
    assert "was killed by SIGSEGV" in done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert ("missing" in trace.result) == (where != "exit")  # it has told that it has told all
        sent = [trace.decode("/numbers", data).data for _, _, data in trace.messages("/numbers")]  # type: ignore[attr-defined]
    for name in range(1, 5):
        own = [number for number in sent if number // 100_000 == name]
        counted = json.loads((tmp_path / str(name)).read_text())
        assert [number for number in own if number in counted] == counted
        assert len(own) - len(counted) in (0, 1)  # it may be interrupted before it has counted one


def test_all_that_a_killed_program_has_done_is_kept(
    tmp_path: Path, command: Any, compiled: Callable[[str], Path]
) -> None:
    program = f"program: {compiled('counter.c')}, name: counter, arguments: ['10', kill]"
    program = f"{{{program}, on_exception: log}}"
    later = "{node: robot:Talker, start_after: {ended: counter}}"
    done = record(tmp_path, f"nodes: [{program}, {later}]\nstop: {{topic: /same, timeout: 300s}}\n")
    assert done.returncode == 0, done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        counts = [trace.decode("/count", data).data for _, _, data in trace.messages("/count")]  # type: ignore[attr-defined]
        assert counts == [1, 2, 3, 4, 5]
        assert len(callbacks(trace, "counter", "timer 1", EventKind.TIMER)) == 5
        assert "which was killed by SIGKILL at " in trace.result["missing"]
    shown = command("info", "run.mcap").stdout
    assert "  missing  " in shown


def started(folder: Path, text: str) -> tuple[subprocess.Popen[str], int]:
    """Start a run with a main that ends by nothing; return it, and the number of that process."""
    process = subprocess.Popen(
        [*COMMAND, "record", "--native", str(job(folder, text)), "-o", "run.mcap"],
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    told = folder / "pid"
    try:
        wait_until(lambda: told.exists() and bool(told.read_text()), process)
    except BaseException:
        process.kill()
        raise
    return process, int(told.read_text())


def is_gone(number: int) -> bool:
    """Return whether a process is there no more."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


DEAF = "nodes: [{main: robot_mains:deaf, arguments: [pid]}, {node: robot:Talker}]\n"


def test_what_cannot_be_observed_of_a_process_is_named(tmp_path: Path) -> None:
    done = record(tmp_path, "nodes: [{main: robot_mains:fork}, {main: robot_mains:become}]\n")
    assert done.returncode == 0, done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        assert set(trace.result["missing"].split("; ")) == {
            "of robot_mains:fork, what 1 copies did that it forked",
            "of robot_mains:become, all after it used os._exit, became another program or closed "
            "rsltrace's file descriptor",
        }
        assert [data[4:] for _, _, data in trace.messages("/numbers")] == [bytes(8)]


def test_ctrl_c_ends_all_processes_even_one_that_does_not_listen(tmp_path: Path) -> None:
    process, deaf = started(tmp_path, DEAF)
    try:
        wait_until(lambda: has_messages(tmp_path / "run.mcap", "/same"), process)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130, said
    assert "robot_mains:deaf did not" in said
    wait_until(lambda: is_gone(deaf))
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        assert trace.result["stop_reason"] == "interrupted"
        assert "/deaf" in {entity.name for entity in trace.entities.values()}
        assert ("/talker0", EventKind.SHUTDOWN) in {
            (trace.entity(e.entity).name, e.kind) for e in events_of(trace)
        }


def test_no_process_outlives_a_run_that_is_killed(tmp_path: Path) -> None:
    process, deaf = started(tmp_path, DEAF)
    children = [
        int(number)
        for number in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ]
    assert deaf in children
    assert len(children) == 2
    wait_until(lambda: has_messages(tmp_path / "run.mcap", "/same"), process)
    process.kill()
    process.communicate()
    wait_until(lambda: all(map(is_gone, children)))
    assert has_messages(tmp_path / "run.mcap", "/same")


def has_messages(path: Path, topic: str) -> bool:
    with suppress(RsltraceError), Trace.open(path) as trace:  # it is being written
        return any(trace.messages(topic))
    return False


def test_the_job_is_judged_before_anything_begins(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text("gain: 2\n")
    for text, said in (
        ("nodes: [{program: /bin/true, parameter_files: [bad.yaml]}]", "bad.yaml is no ROS param"),
        ("nodes: [{node: robot:Talker}, {main: robot:nothing}]", "job.yaml:2:"),
        ("nodes: [{main: robot_mains:talk, stdin: [x]}]", "a native run types nothing"),
        ("nodes: [{node: robot:Talker}]\nbags: [{path: nowhere}]", "nowhere"),
    ):
        done = record(tmp_path, text, "--processes")
        assert (done.returncode, said in done.stderr) == (2, True), done.stderr
        assert "Traceback" not in done.stderr
        assert not (tmp_path / "run.mcap").exists()


@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs unshare")
def test_without_a_network_it_says_so(tmp_path: Path) -> None:
    apart = ["unshare", "-rn"]
    if subprocess.run([*apart, "true"], capture_output=True).returncode:
        pytest.skip("may not make namespaces")
    path = job(tmp_path, "nodes: [{node: robot:Talker}]\nstop: {duration: 1s}")
    done = subprocess.run(
        [*apart, *COMMAND, "record", "--native", "--processes", str(path), "-o", "run.mcap"],
        cwd=tmp_path,
        env={**environment(tmp_path), "PATH": os.environ["PATH"]},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 2
    assert "loopback network is down" in done.stderr
    assert not (tmp_path / "run.mcap").exists()
