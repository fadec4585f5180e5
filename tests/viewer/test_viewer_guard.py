"""What the guard found is shown by the inspector, and keys lead to it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rsltrace_viewer.model.inspector.event import inspect
from rsltrace_viewer.model.inspector.message_tree import Openness
from rsltrace_viewer.model.run import Run

import rsltrace
from rsltrace.trace.reader import Trace

Drive = Callable[..., None]

SAMPLE = Path(__file__).parents[2] / "sample_traces" / "delayed_input" / "a.mcap"

READER = """
import os
from rclpy.node import Node

class Reader(Node):
    def __init__(self):
        super().__init__('reader')
        self.condition = self.create_guard_condition(lambda: None)
        self.turn = 0
        self.create_timer(0.25, self.tick)

    def tick(self):
        self.turn += 1
        self.condition.trigger()
        if self.turn == 3:
            open(__file__).close()
"""


def test_an_event_shows_the_calls_found_in_it_and_others_show_nothing() -> None:
    with Trace.open(SAMPLE) as trace:
        run = Run(trace)
        shown = [(line.label, line.value) for line in inspect(run, 0, Openness())]
        assert ("calls from outside", "1") in shown
        assert ("environment", "os.environ['BUS_SEED'] -> '31'") in shown
        assert any(label == "at" and "rover.py:28" in value for label, value in shown)
        assert not any(line.path.startswith("guard") for line in inspect(run, 200, Openness()))


@pytest.mark.ros
def test_the_keys_of_findings_lead_to_them_and_not_to_guard_conditions(
    tmp_path: Path, drive: Drive
) -> None:
    (tmp_path / "outside.py").write_text(READER)
    (tmp_path / "job.yaml").write_text("nodes: [{node: 'outside:Reader'}]\nstop: {duration: 1s}\n")
    rsltrace.record(rsltrace.load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap")
    with rsltrace.Trace.open(tmp_path / "run.mcap") as trace:
        (found,) = trace.findings
        kinds = [trace.event(index).kind.name for index in range(trace.event_count)]
    assert "GUARD_CONDITION" in kinds

    async def steps(viewer: Any) -> None:
        await viewer.press("u")
        assert viewer.place == found
        await viewer.press("u")
        assert "no later finding" in viewer.text
        await viewer.press("G", "U")
        assert viewer.place == found

    drive(tmp_path / "run.mcap", steps)
