"""Run node classes in a simulation, in this process, and look at the trace."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")


class Recorded:
    """A finished run: its result, and questions about its trace."""

    def __init__(self, result: Any, path: Path) -> None:
        self.result = result
        self.path = path

    def trace(self) -> Any:
        from rsltrace import Trace

        return Trace.open(self.path)

    def events(self) -> list[Any]:
        """All events, as model.event.Event."""
        with self.trace() as trace:
            return [trace.event(index) for index in range(trace.event_count)]

    def kinds(self) -> list[str]:
        return [event.kind.label for event in self.events()]

    def logs(self) -> list[str]:
        """The texts of all log records."""
        with self.trace() as trace:
            return [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]


@pytest.fixture
def simulate(tmp_path: Path) -> Callable[..., Recorded]:
    """Run nodes (classes or functions) and return the recorded run; raise what the run raises."""
    from rsltrace import Job, NodeSpec, StopSpec, record

    def run(*nodes: Any, duration: float | None = None, job: Any = None, **stop: Any) -> Recorded:
        specs = [node if isinstance(node, NodeSpec) else NodeSpec(node=node) for node in nodes]
        options = dict(job or {})
        job_object = Job(
            nodes=specs, stop=StopSpec(duration=duration, **stop), base_dir=tmp_path, **options
        )
        path = tmp_path / "run.mcap"
        return Recorded(record(job_object, path, force=True), path)

    return run
