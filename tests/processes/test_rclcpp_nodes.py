"""Nodes of rclcpp, compiled here, where rclcpp is: executors, threads, services, containers.

It is in no wheel. With a ROS 2 that is sourced (``AMENT_PREFIX_PATH``) these tests run.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace import DebugSession, replay
from rsltrace.adapters.processes.build import find_compiler, find_ros
from rsltrace.diff import diff_files
from rsltrace.diff.report import render
from rsltrace.job import load_job
from rsltrace.run import RunResult, run
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from tests.native.running import record

SOURCES = Path(__file__).parent / "rclcpp_nodes"
PREFIXES = [Path(one) for one in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if one]
_HAS_RCLCPP = any((prefix / "include/rclcpp/rclcpp/rclcpp.hpp").exists() for prefix in PREFIXES)
pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,
    pytest.mark.skipif(not _HAS_RCLCPP, reason="needs rclcpp: source a ROS 2 that has it"),
]
_HAS_COMPONENTS = any(
    (one / "lib/rclcpp_components/component_container").exists() for one in PREFIXES
)
needs_components = pytest.mark.skipif(not _HAS_COMPONENTS, reason="needs rclcpp_components")
_INTERFACES = ("std_msgs", "std_srvs", "rcl_interfaces", "builtin_interfaces", "statistics_msgs")


def _compile(name: str, target: Path, extra: Sequence[str] = ()) -> Path:
    prefixes = [*PREFIXES, find_ros().prefix]
    words = [f"-I{one}" for p in prefixes for one in (p / "include").iterdir() if one.is_dir()]
    words += [f"-I{p / 'include'}" for p in prefixes] + [f"-L{p / 'lib'}" for p in prefixes]
    words += [f"-Wl,-rpath,{p / 'lib'}" for p in prefixes]
    words += [
        "-lrclcpp",
        "-llibstatistics_collector",
        "-lrcl",
        "-lrmw",
        "-lrcutils",
        "-lrcpputils",
        "-ltracetools",
        "-lrosidl_runtime_c",
    ]
    words += [f"-l{package}__rosidl_typesupport_cpp" for package in _INTERFACES]
    words += ["-Wl,--unresolved-symbols=ignore-in-shared-libs", "-pthread", *extra]
    command = [*find_compiler(), "-std=c++17", str(SOURCES / name), "-o", str(target)]
    subprocess.run([*command, *words], check=True)
    return target


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program of ``nodes.cpp``."""
    return _compile("nodes.cpp", tmp_path_factory.mktemp("rclcpp") / "nodes")


@pytest.fixture(scope="module")
def poller(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program of ``poller.cpp``."""
    return _compile("poller.cpp", tmp_path_factory.mktemp("rclcpp") / "poller")


def _run(folder: Path, text: str, name: str = "t.mcap") -> RunResult:
    (folder / "job.yaml").write_text(text)
    return run(load_job(folder / "job.yaml"), folder / name)


def _logs(path: Path) -> list[tuple[int, str, str]]:
    """Return (ms, logger, text) of all log records."""
    with Trace.open(path) as trace:
        records = [(s, trace.decode("/rosout", d)) for s, _, d in trace.messages("/rosout")]
    return [(stamp // 1_000_000, record.name, record.msg) for stamp, record in records]


@pytest.mark.parametrize("executor", ["single", "multi", "static", "events"])
def test_executors_do_what_rclcpp_does_and_each_run_is_the_same(
    nodes: Path, tmp_path: Path, executor: str
) -> None:
    job = f"nodes: [{{program: {nodes}, arguments: [{executor}]}}]\nstop: {{duration: 3s}}\n"
    results = [_run(tmp_path, job, f"{number}.mcap") for number in range(3)]
    assert [result.error for result in results] == [None] * 3
    assert len({result.digest for result in results}) == 1
    logs = _logs(tmp_path / "0.mcap")
    heard = [text.split()[1] for _, _, text in logs if text.startswith("heard")]
    second = "1001" if executor == "events" else "2"  # which of two tied timers is the first
    assert heard[:4] == ["1", second, "1002", "1003"]
    assert [text for _, _, text in logs if text.startswith("it is")][:2] == [
        "it is off",
        "it is on",
    ]
    assert sum(text == "latched 42" for _, _, text in logs) == 1
    if executor == "events":  # its timers are sleeps to the loop
        return
    with Trace.open(tmp_path / "0.mcap") as trace:
        timers = [e.name for e in trace.entities.values() if e.kind is EntityKind.TIMER]
    assert timers == ["Talker::Talker()::{lambda()#1}", "Talker::Talker()::{lambda()#2}",
                      "Listener::Listener()::{lambda()#2}"]  # fmt: skip


def test_intra_process_communication_is_off_unless_the_job_leaves_it_on(tmp_path: Path) -> None:
    program = _compile("inside.cpp", tmp_path / "inside", ["-g"])
    for more, expected in (("", 10), (", intra_process: true", 0)):
        job = f"nodes: [{{program: {program}{more}}}]\nstop: {{duration: 1s}}\n"
        result = _run(tmp_path, job, f"{expected}.mcap")
        assert "intra" in "".join(result.notes)
        with Trace.open(tmp_path / f"{expected}.mcap") as trace:
            of_count = [one for one in trace.entities.values() if one.name == "/count"]
            (heard,) = [one for one in of_count if one.kind is EntityKind.SUBSCRIPTION]
            events = [trace.event(index) for index in range(trace.event_count)]
        assert sum(event.entity == heard.id for event in events) == expected
        assert heard.source.endswith("inside.cpp:21")  # of a std::bind: where it is subscribed


@pytest.mark.native
@pytest.mark.parametrize("executor", ["single", "multi", "events"])
def test_native_runs_have_every_callback_with_its_cause(
    nodes: Path, tmp_path: Path, executor: str
) -> None:
    text = f"nodes: [{{program: {nodes}, arguments: [{executor}]}}]\nstop: {{duration: 3s}}\n"
    done = record(tmp_path, text)
    assert done.returncode == 0, done.stderr
    heard = [text for _, _, text in _logs(tmp_path / "run.mcap") if text.startswith("heard")]
    assert len(heard) > 20
    with Trace.open(tmp_path / "run.mcap") as trace:
        names = {entity.id: entity.name for entity in trace.entities.values()}
        events = [trace.event(index) for index in range(trace.event_count)]
        runs = Counter((names[event.entity], event.kind) for event in events)
        sent = [trace.outputs_of(one.index) for one in events if one.kind is EventKind.TIMER]
        counts = [o for outputs in sent for o in outputs if names[o.entity] == "/count"]
        assert runs["/count", EventKind.SUBSCRIPTION] == 2 * len(heard)
        assert runs["Talker::Talker()::{lambda()#1}", EventKind.TIMER] in range(25, 31)
        assert len(counts) - len(heard) in {0, 1}
        responses = [
            [names[output.entity] for output in trace.outputs_of(event.index)]
            for event in events
            if (names[event.entity], event.kind) == ("/enable", EventKind.SERVICE)
        ]
        assert responses == [["/enable"]] * runs["/enable", EventKind.CLIENT]
        assert trace.result["unknown_causes"] == "0"
    if executor == "events":  # its timers are sleeps to the loop, and have no turn
        return
    again = replay(tmp_path / "run.mcap", trust=True, job_folder=tmp_path)
    assert any(note.startswith("all ") and "in its order" in note for note in again.notes)
    assert "callbacks started in the same order" in again.sentence


@pytest.mark.parametrize("call", ["some", "all", "once"])
@pytest.mark.parametrize("executor", ["single", "multi", "static", "events"])
def test_a_loop_at_a_rate_gets_all_that_there_is_in_the_order_of_the_loop(
    poller: Path, tmp_path: Path, executor: str, call: str
) -> None:
    program = f"program: {poller}, arguments: "
    job = f"nodes: [{{{program}[source]}}, {{{program}[{executor}, {call}]}}]\n"
    digests = []
    for pins in ("true", "false"):  # with fixed addresses, and with random ones
        more = f"stop: {{duration: 2s}}\nguard: {{pin: {pins}}}\n"
        result = _run(tmp_path, job + more, f"{pins}.mcap")
        assert result.error is None
        digests.append(result.digest)
        assert not any("full queues" in note for note in result.notes)
    with Trace.open(tmp_path / "true.mcap") as trace:
        seen = [trace.decode("/seen", data).data for _, _, data in trace.messages("/seen")]  # type: ignore[attr-defined]
    # EventsExecutor::spin_once(0) runs no timer that is due this very nanosecond.
    timers = () if (executor, call) == ("events", "once") else (10, 11)
    counts = [seen.count(number) for number in (*range(8), *timers)]
    assert min(counts) >= 98
    assert max(counts) <= 100
    assert seen.count(20) >= 9
    if executor != "static":  # that goes by addresses, and does not say when it looks
        assert digests[0] == digests[1]
    if executor in ("single", "multi") and call != "once":
        at = seen.index(0)
        assert seen[at : at + 8] == list(range(8))


@pytest.fixture
def composed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A job whose launch file has a container load two components."""
    prefix = tmp_path / "install"
    index = prefix / "share/ament_index/resource_index"
    for kind, content in (
        ("packages", ""),
        ("rclcpp_components", "tried::Counter;lib/libtried.so"),
    ):
        (index / kind).mkdir(parents=True)
        (index / kind / "tried").write_text(content)
    (prefix / "lib").mkdir()
    extra = ["-shared", "-fPIC", "-lclass_loader", "-lconsole_bridge", "-lcomponent_manager"]
    _compile("component.cpp", prefix / "lib" / "libtried.so", extra)
    listed = os.environ["AMENT_PREFIX_PATH"]
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{prefix}:{listed}")
    launch = """<launch>
      <node_container pkg="rclcpp_components" exec="component_container" name="c" namespace="cam">
        <composable_node pkg="tried" plugin="tried::Counter" name="one">
          <param name="first" value="10"/>
          <remap from="count" to="here"/>
        </composable_node>
        <composable_node pkg="tried" plugin="tried::Counter" name="two" namespace="n">
          <remap from="other" to="/here"/>
        </composable_node>
      </node_container>
    </launch>"""
    (tmp_path / "a.launch.xml").write_text(launch)
    return "launch: [a.launch.xml]\nstop: {duration: 2s}\n"


@needs_components
def test_a_container_loads_components(composed: str, tmp_path: Path) -> None:
    results = []
    for number in range(3):
        results.append(_run(tmp_path, composed, f"{number}.mcap"))
    assert [result.error for result in results] == [None] * 3
    assert len({result.digest for result in results}) == 1
    heard = [(name, text) for _, name, text in _logs(tmp_path / "0.mcap") if "heard" in text]
    assert heard[:2] == [("n.two", "heard 10"), ("n.two", "heard 11")]
    with Trace.open(tmp_path / "0.mcap") as trace:
        nodes = [e.name for e in trace.entities.values() if e.kind is EntityKind.NODE]
        assert {"/cam/c", "/one", "/n/two"} <= set(nodes)
        owners = {e.node for e in trace.entities.values() if e.kind is EntityKind.TIMER}
        assert len(owners) == 2
        kinds = [trace.event(index).kind for index in range(trace.event_count)]
    assert EventKind.SERVICE in kinds


@needs_components
@pytest.mark.native
@pytest.mark.skipif(
    importlib.util.find_spec("composition_interfaces") is None, reason="needs LoadNode over DDS"
)
def test_a_container_loads_components_natively(composed: str, tmp_path: Path) -> None:
    done = record(tmp_path, composed)
    assert done.returncode == 0, done.stderr
    assert "ended at" not in done.stderr
    heard = [text for _, name, text in _logs(tmp_path / "run.mcap") if name == "n.two"]
    assert heard[0].startswith("heard 1")


@needs_components
def test_a_component_that_is_not_there_is_named(tmp_path: Path) -> None:
    job = """
nodes:
  - {executable: rclcpp_components/component_container, name: c}
  - {component: "nowhere/nowhere::Class", container: /c}
stop: {duration: 1s}
"""
    error = str(_run(tmp_path, job).error)
    assert "/c cannot load nowhere/nowhere::Class: " in error


def test_what_a_callback_draws_is_named_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # below it places would be paths
    program = _compile("draws.cpp", tmp_path / "draws", ["-g"])
    line_of = {
        text: number
        for number, text in enumerate((SOURCES / "draws.cpp").read_text().splitlines(), 1)
    }
    draws, reads, publishes = (
        next(f"draws.cpp:{line_of[text]}" for text in line_of if part in text)
        for part in ("std::random_device", "getpid()", "publish(")
    )
    job = f"nodes: [{{program: {program}, arguments: [WHAT]}}]\nstop: {{duration: 2s}}\n"
    for number in range(2):
        _run(tmp_path, f"{job}seed: {number}\n", f"{number}.mcap")
        _run(tmp_path, job.replace("WHAT", "pid"), f"pid{number}.mcap")
    of_seed = render(diff_files(str(tmp_path / "0.mcap"), str(tmp_path / "1.mcap")))
    assert "drew std::random_device() (" in of_seed
    assert f"at {draws}" in " ".join(of_seed.split())
    assert f"message on /drawn (std_msgs/msg/UInt64), at {publishes}" in of_seed
    of_pid = render(diff_files(str(tmp_path / "pid0.mcap"), str(tmp_path / "pid1.mcap")))
    assert "likely cause: /draws read getpid() (" in " ".join(of_pid.split())
    assert f"at {reads}" in of_pid
    assert "guard: {state: record}" not in of_pid
    with Trace.open(tmp_path / "0.mcap") as trace:
        calls = {(count.call, count.node) for count in trace.guarded}
        timer = next(e for e in trace.entities.values() if e.kind is EntityKind.TIMER)
    assert {("rand()", "/draws"), ("time()", "/draws")} <= calls
    assert timer.source.startswith("draws.cpp:")


@pytest.mark.skipif(shutil.which("gdb") is None, reason="needs gdb")
def test_gdb_stops_in_the_callback_of_an_event(tmp_path: Path) -> None:
    program = _compile("tracker.cpp", tmp_path / "tracker", ["-g"])
    _run(tmp_path, f"nodes: [{{program: {program}}}]\nstop: {{duration: 3s}}\n")
    with DebugSession(tmp_path / "t.mcap", trust=True) as session:
        index = session.run_to("1.4s").position.index
        (found,) = session.inspect("processes")
        assert found["nodes"] == ["/tracker"]
        (line,) = found["callbacks"]
        words = [f"break {line}", "continue", "up", "bt 1", "detach"]
        command = ["gdb", "-nx", "-batch", "-p", str(found["pid"])]
        with subprocess.Popen(
            [*command, *(word for one in words for word in ("-ex", one))],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as gdb:
            assert gdb.stdout is not None
            said = ""
            for text in gdb.stdout:
                said += text
                if "not permitted" in text:
                    gdb.kill()
                    pytest.skip("this system lets nobody attach to a process")
                if text.startswith("Breakpoint 1"):
                    break
            position = session.step().position
            said += gdb.stdout.read()
        assert position.index == index + 1
    assert "hit Breakpoint 1" in said
    assert line.partition(":")[0] in said.partition("hit Breakpoint 1")[2]
