"""Jobs in folders of their own, recorded and replayed in this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

NODES = """
import os
from rclpy.node import Node
from std_msgs.msg import Float64, UInt64

class Source(Node):
    def __init__(self, period=0.1):
        super().__init__('source')
        self.count = 0
        self.gain = self.declare_parameter('gain', 1.5).value
        self.out = self.create_publisher(Float64, 'speed', 10)
        self.create_timer(period, self.tick)

    def tick(self):
        self.count += 1
        self.out.publish(Float64(data=self.gain * self.count + 0.25))

class Filter(Node):
    def __init__(self):
        super().__init__('filter')
        self.state = 0.0
        self.out = self.create_publisher(Float64, 'smooth', 10)
        self.create_subscription(Float64, 'speed', self.got, 10)

    def got(self, message):
        self.state = 0.75 * self.state + 0.125 * message.data
        self.out.publish(Float64(data=self.state))

class Watch(Node):
    def __init__(self):
        super().__init__('watch')
        self.warned = 0
        self.create_subscription(Float64, 'smooth', self.got, 10)

    def got(self, message):
        if message.data > 2.5:
            self.warned += 3
            self.get_logger().warn(f'too fast: {message.data:.3f}, {self.warned}')
"""

JOB = """\
nodes:
  - {node: nodes_of_replay:Source, parameters: {gain: 2.0}}
  - node: nodes_of_replay:Filter
  - node: nodes_of_replay:Watch
stop: {duration: 3s}
seed: 3
"""


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[..., Path]:
    """Write a job and its nodes, record it, and return the trace."""

    def go(job: str = JOB, code: str = "", *, name: str = "run.mcap", **options: Any) -> Path:
        from rsltrace.job import load_job
        from rsltrace.run import run

        (tmp_path / "nodes_of_replay.py").write_text(NODES + code)
        (tmp_path / "job.yaml").write_text(job)
        overrides = options.pop("overrides", ())
        loaded = load_job(tmp_path / "job.yaml", overrides=overrides)
        path: Path = run(loaded, tmp_path / name, force=True, **options).path  # type: ignore[assignment]
        return path

    return go
