"""A job of three nodes and its trace, which the tests of debugging sessions share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rsltrace import DebugSession
    from rsltrace.trace.reader import Trace

NODES = """
from rclpy.node import Node
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

class Source(Node):
    def __init__(self):
        super().__init__('source')
        self.count = 0
        self.out = self.create_publisher(Float64, 'speed', 10)
        self.create_timer(0.01, self.tick)

    def tick(self):
        self.count += 1
        self.out.publish(Float64(data=1.5 * self.count))

class Model:
    __slots__ = ('last', '__dict__')

    def __init__(self, node):
        self.last = 0.0
        self.noise = Noise(node)

class Noise:
    def __init__(self, node):
        self.level = 0
        self.node = node

class Filter(Node):
    def __init__(self):
        super().__init__('filter')
        self.model = Model(self)
        self.state = 0.0
        self.warned = None
        self.out = self.create_publisher(Float64, 'smooth', 10)
        self.create_subscription(Float64, 'speed', self.got, 10)

    def got(self, message):
        self.state = 0.75 * self.state + 0.125 * message.data
        self.model.last = message.data
        self.model.noise.level += 1
        if self.state > 100 and self.warned is None:
            self.warned = self.get_clock().now().nanoseconds
            self.get_logger().warn('too fast')
        self.out.publish(Float64(data=self.state))

class Watch(Node):
    def __init__(self):
        super().__init__('watch')
        self.last = 0.0
        self.create_subscription(Float64, 'smooth', self.got, 10)
        self.create_service(Trigger, 'reset', self.reset)

    def got(self, message):
        self.last = message.data

    def reset(self, request, response):
        self.last = 0.0
        return response
"""

JOB = """\
nodes:
  - node: nodes_of_debug:Source
  - node: nodes_of_debug:Filter
  - node: nodes_of_debug:Watch
stop: {duration: 3s}
guard: {state: true}
"""


@pytest.fixture(scope="package")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``job.yaml``, its nodes and its trace ``run.mcap``."""
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    from rsltrace.job import load_job
    from rsltrace.run import record

    made = tmp_path_factory.mktemp("debug")
    (made / "nodes_of_debug.py").write_text(NODES)
    (made / "job.yaml").write_text(JOB)
    record(load_job(made / "job.yaml"), made / "run.mcap")
    return made


@pytest.fixture(scope="module")
def shared(folder: Path) -> Iterator[DebugSession]:
    from rsltrace import DebugSession

    with DebugSession(folder / "run.mcap", trust=True) as session:
        yield session


@pytest.fixture
def session(shared: DebugSession) -> DebugSession:
    """The session of a module, at its begin and without breakpoints."""
    for one in shared.breakpoints:
        shared.clear(one.number)
    shared.go_to(0)
    return shared


@pytest.fixture(scope="module")
def trace(folder: Path) -> Iterator[Trace]:
    from rsltrace.trace.reader import Trace

    with Trace.open(folder / "run.mcap") as opened:
        yield opened
