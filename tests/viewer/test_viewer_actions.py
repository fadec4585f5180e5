"""An action's goal is shown where it is worked on, and a wait that was over says so."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from rsltrace_viewer.model.inspector.event import inspect
from rsltrace_viewer.model.inspector.message_tree import Openness
from rsltrace_viewer.model.run import Run

import rsltrace
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
pytest.importorskip("test_msgs", reason="needs the interfaces of test_msgs")


def _server() -> Any:
    from rclpy.action import ActionClient, ActionServer
    from rclpy.node import Node
    from test_msgs.action import Fibonacci

    class Both(Node):
        def __init__(self) -> None:
            super().__init__("both")
            self.server = ActionServer(self, Fibonacci, "count", self.work)
            self.client = ActionClient(self, Fibonacci, "count")
            self.once = self.create_timer(0.1, self.ask)

        def ask(self) -> None:
            self.once.cancel()
            self.client.send_goal_async(Fibonacci.Goal(order=5))

        def work(self, handle: Any) -> Any:
            time.sleep(0.25)
            handle.succeed()
            return Fibonacci.Result(sequence=[1, 2])

    return Both()


def test_a_goal_is_shown_where_it_is_worked_on(tmp_path: Path) -> None:
    job = rsltrace.Job(
        nodes=[rsltrace.NodeSpec(node=_server)], stop=rsltrace.StopSpec(duration="1s")
    )
    rsltrace.record(job, tmp_path / "run.mcap")
    with Trace.open(tmp_path / "run.mcap") as trace:
        run = Run(trace)
        events = [trace.event(index) for index in range(trace.event_count)]
        task, resumed = (
            next(event for event in events if event.kind.name == kind)
            for kind in ("TASK", "RESUME")
        )
        shown = {
            line.path: (line.label, line.value) for line in inspect(run, task.index, Openness())
        }
        assert shown["in"][1].startswith("call /count/_action/send_goal")
        assert ("order", "5") in shown.values(), shown
        assert not any("not recorded" in value for _, value in shown.values())
        lines = inspect(run, resumed.index, Openness())
        assert ("cause", "no other event: its wait was over") in {
            (line.label, line.value) for line in lines
        }
        silent = [
            line.value
            for event in events
            for line in inspect(run, event.index, Openness())
            if "not recorded" in line.value
        ]
        assert not silent, "what never has a payload is not missing one"
