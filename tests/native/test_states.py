"""Native runs of what rcl or a node makes without the node's ``create_…`` functions."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from rsltrace.trace.model.event import NO_EVENT, EventKind
from rsltrace.trace.reader import Trace
from tests.native.running import events_of, record

pytestmark = [
    pytest.mark.ros,
    pytest.mark.native,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs rclpy"),
]

JOB = """
nodes: [{node: states:Managed}, {node: states:ByHand}, {node: states:Manager}]
stop: {topic: /over, timeout: 300s}
"""


@pytest.mark.parametrize("words", [(), ("--processes",)])
def test_lifecycle_nodes_and_services_made_by_hand_answer(
    tmp_path: Path, words: tuple[str, ...], command: Any
) -> None:
    done = record(tmp_path, JOB, *words)
    assert done.returncode == 0, done.stderr
    assert "/over" in done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        trace.check()
        events = events_of(trace)
        for event in events:
            if event.kind in (EventKind.SUBSCRIPTION, EventKind.SERVICE, EventKind.CLIENT):
                assert event.cause_event != NO_EVENT, trace.entity(event.entity)
        sent = [
            trace.entity(output.entity).name
            for event in events
            for output in trace.outputs_of(event.index)
            if output.kind == 1
        ]
        assert sent.count("/managed/transition_event") == 8
        assert trace.result["unknown_causes"] == "0"
    simulated = command("record", "job.yaml", "-o", "simulated.mcap", "-q")
    assert simulated.returncode == 0, simulated.stderr
    compared = command("diff", "run.mcap", "simulated.mcap", "--ignore", "/rosout")
    assert compared.returncode == 3, compared.stdout
