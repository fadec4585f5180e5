"""RSLCPP's determinism network as processes: every callback in the same order as in one process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

NETWORK = Path(__file__).parents[2] / "examples" / "rslcpp_determinism"
CALLBACKS = (EventKind.TIMER, EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT)
TOPICS = ("/t1", "/t2", "/t3", "/t4", "/t5")
FINAL_STATES = [
    13404255130693361018,
    6314714395288068323,
    271694970909356762,
    18227695353861151360,
]
MAIN = """
import sys
import nodes, rclpy

from rclpy.executors import ExternalShutdownException

rclpy.init()
node = getattr(nodes, sys.argv[1])()
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    print('final state', getattr(node, 'state', 0), flush=True)
"""
SETTINGS = """
construct_time: 0s
start: 10s
stop:
  topic: {name: /rslcpp/error_code, exit_code: data}
"""


def _record(folder: Path, name: str, entries: Iterator[str]) -> Path:
    text = f"search_path: ['{NETWORK}']\nnodes:\n" + "".join(entries) + SETTINGS
    (folder / f"{name}.yaml").write_text(text)
    result = run(load_job(folder / f"{name}.yaml"), folder / f"{name}.mcap")
    assert (result.error, result.exit_code, result.end_ns) == (None, 0, 110 * 10**9)
    return folder / f"{name}.mcap"


def _callbacks(path: Path) -> list[tuple[int, str, str, object]]:
    """Return (stamp, kind, node, what) of every callback but the monitor's."""
    found = []
    with Trace.open(path) as trace:
        entities = trace.entities
        for index in range(trace.event_count):
            event = trace.event(index)
            if event.kind not in CALLBACKS:
                continue
            entity = entities[event.entity]
            node = entities[entity.node].name
            what = entity.detail["period_ns"] if event.kind is EventKind.TIMER else entity.name
            if node != "/monitor":
                found.append((event.stamp_ns, event.kind.label, node, what))
    return found


def _messages(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    with Trace.open(path) as trace:
        return {t: [(s, bytes(data)) for s, _, data in trace.messages(t)] for t in TOPICS}


@pytest.fixture(scope="module")
def in_one_process(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The network as it is recorded in rsltrace's own process."""
    names = ("NodeA", "NodeB", "NodeC", "NodeD", "Monitor")
    entries = (f"  - node: nodes:{name}\n" for name in names)
    return _record(tmp_path_factory.mktemp("network"), "here", entries)


def test_c_programs_run_the_network_as_python_nodes_do(
    in_one_process: Path, compiled: Callable[[str], Path], tmp_path: Path
) -> None:
    program = compiled("network.c")
    entries = (
        f"  - program: {program}\n    arguments: [{name}]\n"
        for name in ("a", "b", "c", "d", "monitor")
    )
    path = _record(tmp_path, "c", entries)
    callbacks = _callbacks(path)
    assert len(callbacks) == 19_011
    assert callbacks == _callbacks(in_one_process)
    assert _messages(path) == _messages(in_one_process)
    with Trace.open(path) as trace:
        logs = [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]  # type: ignore[attr-defined]
    assert logs == [f"final state {state}" for state in FINAL_STATES]


@pytest.mark.long
def test_python_processes_run_the_network_as_nodes_of_this_process_do(
    in_one_process: Path, compiled: object, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "main.py").write_text(MAIN)
    names = ("NodeA", "NodeB", "NodeC", "NodeD", "Monitor")
    entries = (
        f"  - script: main.py\n    isolated: true\n    arguments: [{name}]\n" for name in names
    )
    path = _record(tmp_path, "python", entries)
    assert _callbacks(path) == _callbacks(in_one_process)
    assert _messages(path) == _messages(in_one_process)
    states = [int(line.split()[-1]) for line in capfd.readouterr().out.splitlines()]
    assert states == [*FINAL_STATES, 0]
