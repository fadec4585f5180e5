"""Small graphs to search: a job, its nodes, and workers that run its trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

NODES = """
import ctypes
from rclpy.node import Node
from std_msgs.msg import UInt64


class Sender(Node):
    def __init__(self):
        super().__init__('sender')
        value = self.declare_parameter('value', 1).value
        topic = self.declare_parameter('topic', 'a').value
        self.publisher = self.create_publisher(UInt64, topic, 10)
        self.create_timer(0.1, lambda: self.publisher.publish(UInt64(data=value)))


class Last(Node):
    '''Publishes what it has received last: which sender came last matters to it.'''

    def __init__(self):
        super().__init__('last')
        self.value = 0
        self.publisher = self.create_publisher(UInt64, 'last', 10)
        for topic in ('a', 'b'):
            self.create_subscription(UInt64, topic, self.got, 10)
        self.create_timer(0.1, self.tick)

    def got(self, message):
        self.value = message.data

    def tick(self):
        self.publisher.publish(UInt64(data=self.value))


class Relay(Node):
    def __init__(self):
        super().__init__('relay')
        publisher = self.create_publisher(UInt64, self.declare_parameter('to', 'a').value, 10)
        topic = self.declare_parameter('from', 'b').value
        self.create_subscription(UInt64, topic, publisher.publish, 10)


class Bad(Node):
    def __init__(self):
        super().__init__('bad')
        self.create_timer(0.1, getattr(self, self.declare_parameter('how', 'raises').value))

    def raises(self):
        raise ValueError('this is bad')

    def dies(self):
        ctypes.string_at(0)

    def hangs(self):
        while True:
            pass

    def works(self):
        pass
"""

JOB = """\
nodes:
  - {node: nodes_under_search:Sender, name: one, parameters: {value: 1, topic: a}}
  - {node: nodes_under_search:Sender, name: two, parameters: {value: 2, topic: b}}
  - {node: nodes_under_search:Last}
stop: {duration: 0.15s}
"""


@pytest.fixture(scope="session")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nodes, and ``job.yaml`` of two senders and one that minds their order."""
    folder = tmp_path_factory.mktemp("searched")
    (folder / "nodes_under_search.py").write_text(NODES)
    (folder / "job.yaml").write_text(JOB)
    (folder / "bad.yaml").write_text(
        "nodes: [{node: nodes_under_search:Bad}]\nstop: {duration: 1s}\n"
    )
    return folder


@pytest.fixture(scope="session")
def write_job(searched: Path) -> Callable[[str, str], Path]:
    """Write a job with these nodes beside them."""

    def write(name: str, text: str) -> Path:
        path = searched / f"{name}.yaml"
        path.write_text(text)
        return path

    return write


@pytest.fixture(scope="module")
def worker(searched: Path) -> Iterator[object]:
    """A worker for ``job.yaml``."""
    from rsltrace.search.explore.trial import JobSource
    from rsltrace.search.explore.workers import Worker

    with Worker(JobSource(str(searched / "job.yaml"))) as one:
        yield one
