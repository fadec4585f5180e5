"""Edits that overlap: which event runs when, compared with a model of a few lines."""

from __future__ import annotations

from bisect import insort
from collections import deque
from math import inf
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import rsltrace
from rsltrace.job import load_job
from rsltrace.replay.edits import DeferEdit, DropEdit, parse_edit
from rsltrace.run import run
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

NODES = """
from rclpy.node import Node
from std_msgs.msg import UInt64

class Source(Node):
    def __init__(self):
        super().__init__('source')
        self.out = self.create_publisher(UInt64, 'a', 10)
        self.create_timer(1.0, lambda: self.out.publish(UInt64(data=1)))

class Sinks(Node):
    def __init__(self):
        super().__init__('sinks')
        for number in range(9):
            self.create_subscription(UInt64, 'a', lambda message: None, 10)
"""
JOB = """
nodes: [{node: 'nodes_of_defers:Source'}, {node: 'nodes_of_defers:Sinks'}]
stop: {duration: 1s}
"""
FIRST, COUNT = 3, 9
"""The subscriptions are events 3 to 11; the run stops at the time at which they run."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("defers")
    (folder / "nodes_of_defers.py").write_text(NODES)
    for name, more in (
        ("plain", ""),
        ("ordered", "policy: {order: fifo}\nexecutors: single_threaded\n"),
    ):
        (folder / "job.yaml").write_text(JOB + more)
        run(load_job(folder / "job.yaml"), folder / f"{name}.mcap")
    return folder


def order(path: Path) -> list[int]:
    """Return the subscriptions in the order in which they ran, from 0."""
    with Trace.open(path) as trace:
        events = [trace.event(index) for index in range(trace.event_count)]
        ids = [e.id for e in trace.entities.values() if e.kind.name == "SUBSCRIPTION"]
        ran = [e.entity for e in events if e.kind is EventKind.SUBSCRIPTION]
        return [sorted(ids).index(entity) for entity in ran]


def branch(folder: Path, *edits: str, name: str = "plain") -> list[int]:
    """Return the order of a branch, which replays with every event verified."""
    made = folder / "branch.mcap"
    rsltrace.replay(folder / f"{name}.mcap", edits=edits, output=made, force=True, trust=True)
    assert rsltrace.replay(made, trust=True).is_whole
    return order(made)


def modelled(edits: list[str]) -> list[int]:
    """Return the order that edits are to give: events wait in a line, sorted by the event before
    which they run; the first runs when it is time or when nothing else is ready."""
    pending = [parse_edit(text) for text in edits]
    ready, line, ran = deque(range(COUNT)), [], []
    added = 0
    while ready or line:
        now = FIRST + len(ran)
        is_time = bool(line) and line[0][0] <= now
        item = line.pop(0)[2] if line and (is_time or not ready) else ready.popleft()
        for edit in [one for one in pending if one.index is not None and one.index <= now]:
            pending.remove(edit)
            if isinstance(edit.action, DropEdit):
                break
            assert isinstance(edit.action, DeferEdit)
            others = edit.action.count
            added += 1
            insort(line, (inf if others is None else now + others, added, item))
            break
        else:
            ran.append(item)
    return ran


@pytest.mark.long
def test_defers_that_overlap(folder: Path) -> None:
    edits = ["3: defer(2)", "4: defer(4)"]
    assert modelled(edits) == [1, 3, 0, 4, 5, 2, 6, 7, 8]
    assert branch(folder, *edits) == [1, 3, 0, 4, 5, 2, 6, 7, 8]


def test_an_event_deferred_when_the_run_stops_still_runs(folder: Path) -> None:
    assert branch(folder, "4: defer()") == [0, 2, 3, 4, 5, 6, 7, 8, 1]
    assert branch(folder, "11: defer()") == list(range(COUNT))


@pytest.mark.long
def test_an_edit_finds_an_event_that_another_has_moved(folder: Path) -> None:
    assert branch(folder, "3: defer(2)", "5: drop()") == [1, 2, 3, 4, 5, 6, 7, 8]
    assert branch(folder, "3: defer(1)", "4: defer(1)") == [1, 2, 0, 3, 4, 5, 6, 7, 8]


EDITS = st.lists(
    st.builds(
        lambda index, action: f"{index}: {action}",
        st.integers(FIRST, FIRST + COUNT - 4),
        st.sampled_from(("drop()", "defer()", *(f"defer({count})" for count in range(1, 8)))),
    ),
    min_size=1,
    max_size=4,
)


@pytest.mark.long
@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(edits=EDITS, name=st.sampled_from(("plain", "ordered")))
def test_any_edits_of_order_are_as_in_the_model(folder: Path, edits: list[str], name: str) -> None:
    assert branch(folder, *edits, name=name) == modelled(edits)
