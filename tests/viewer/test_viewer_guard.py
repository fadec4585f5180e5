"""The inspector shows what the guard found in an event."""

from __future__ import annotations

from pathlib import Path

from rsltrace_viewer.model.inspector import inspect
from rsltrace_viewer.model.lines import Openness
from rsltrace_viewer.model.run import Run

from rsltrace.trace.reader import Trace

SAMPLE = Path(__file__).parents[2] / "sample_traces" / "delayed_input" / "a.mcap"


def test_an_event_shows_the_calls_found_in_it_and_others_show_nothing() -> None:
    with Trace.open(SAMPLE) as trace:
        run = Run(trace)
        shown = [(line.label, line.value) for line in inspect(run, 0, Openness())]
        assert ("calls from outside", "1") in shown
        assert ("environment", "os.environ['BUS_SEED'] -> '31'") in shown
        assert any(label == "at" and "rover.py:28" in value for label, value in shown)
        assert not any(line.path.startswith("guard") for line in inspect(run, 200, Openness()))
