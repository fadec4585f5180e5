"""``parallel: true``: processes compute at the same time, and the trace is that of one by one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.adapters.processes.build import find_compiler, find_ros
from rsltrace.errors import SetupError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

NODE = """
import sys
import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt64
from std_srvs.srv import SetBool

class Relay(Node):
    '''Sends what it hears on one topic to others, several times, and calls a service.'''

    def __init__(self, name, hears, depth, *sends):
        super().__init__(name)
        self.heard = 0
        self.publishers_ = [self.create_publisher(UInt64, topic, 2) for topic in sends]
        self.create_subscription(UInt64, hears, self.on_number, int(depth))
        self.create_service(SetBool, f'{name}/set', self.on_set)
        self.others = [
            self.create_client(SetBool, f'{other}/set') for other in 'abc' if other != name
        ]

    def on_number(self, number):
        self.heard = (31 * self.heard + number.data) % 1000003
        for publisher in self.publishers_:
            for _ in range(1 + self.heard % 3):
                publisher.publish(UInt64(data=self.heard))
        client = self.others[self.heard % 2]
        if client.service_is_ready():
            client.call_async(SetBool.Request(data=self.heard % 5 == 0)).add_done_callback(
                lambda future: self.get_logger().info(future.result().message)
            )

    def on_set(self, request, response):
        count = self.count_publishers('extra')
        response.message = f'{self.get_name()} {self.heard} {count} {request.data}'
        if request.data and self.heard % 7 == 0:
            self.publishers_.append(self.create_publisher(UInt64, 'extra', 2))
        return response

rclpy.init()
rclpy.spin(Relay(*sys.argv[1:]))
"""

SOURCE = """
from rclpy.node import Node
from std_msgs.msg import UInt64

class Source(Node):
    def __init__(self):
        super().__init__('source')
        self.count = 0
        self.publisher = self.create_publisher(UInt64, 'number', 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.count += 1
        for _ in range(self.count % 3):
            self.publisher.publish(UInt64(data=self.count))
"""

JOB = """
parallel: {parallel}
nodes:
  - node: source:Source
  - {{script: relay.py, isolated: true, arguments: [a, number, '1', fused]}}
  - {{script: relay.py, isolated: true, arguments: [b, number, '3', fused, other]}}
  - {{script: relay.py, isolated: true, arguments: [c, fused, '1', other]}}
  - {{script: relay.py, isolated: true, arguments: [d, other, '2']}}
stop: {{duration: 3s}}
"""


@pytest.fixture(autouse=True)
def _can_run() -> None:
    try:
        find_ros(), find_compiler()
    except SetupError as error:
        pytest.skip(str(error))


def test_the_trace_is_that_of_one_by_one(tmp_path: Path) -> None:
    """Queues of one message, bursts, services, questions about the graph, new publishers."""
    (tmp_path / "relay.py").write_text(NODE)
    (tmp_path / "source.py").write_text(SOURCE)
    digests, traces = [], []
    for parallel in ("false", "true"):
        (tmp_path / "job.yaml").write_text(JOB.format(parallel=parallel))
        path = tmp_path / f"{parallel}.mcap"
        result = run(load_job(tmp_path / "job.yaml"), path)
        assert result.error is None
        digests.append((result.digest, result.events))
        with Trace.open(path) as trace:
            topics = sorted({channel.topic for channel in trace.channels.values()})
            said = [one for one in topics if not one.startswith("/rsltrace/")]
            traces.append([(one, *trace.messages(one)) for one in said])
    assert digests[0] == digests[1]
    assert digests[0][1] > 200
    assert traces[0] == traces[1]


MEETING = """
import sys
from pathlib import Path
import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt64

class Meeting(Node):
    def __init__(self, name, other):
        super().__init__(name)
        self.heard = 0
        self.mine, self.other = name, other
        self.publisher = self.create_publisher(UInt64, f'{name}/met', 10)
        self.create_subscription(UInt64, 'number', self.on_number, 10)

    def on_number(self, number):
        self.heard += 1
        Path(f'{self.mine}{self.heard}').touch()
        while not Path(f'{self.other}{self.heard}').exists():
            pass
        self.publisher.publish(number)

rclpy.init()
rclpy.spin(Meeting(*sys.argv[1:]))
"""


def test_two_compute_at_the_same_time(tmp_path: Path) -> None:
    """Each waits in its callback until the other is in its own: one by one, that never ends."""
    (tmp_path / "meeting.py").write_text(MEETING)
    (tmp_path / "source.py").write_text(SOURCE)
    (tmp_path / "job.yaml").write_text(
        "parallel: true\n"
        "nodes:\n"
        "  - node: source:Source\n"
        "  - {script: meeting.py, isolated: true, arguments: [a, b]}\n"
        "  - {script: meeting.py, isolated: true, arguments: [b, a]}\n"
        "stop: {duration: 750ms}\n"
    )
    command = [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", "t.mcap", "--quiet"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    with Trace.open(tmp_path / "t.mcap") as trace:
        met = {
            name: [bytes(data) for _, _, data in trace.messages(f"/{name}/met")] for name in "ab"
        }
    assert len(met["a"]) == 7
    assert met["a"] == met["b"]


ENDING = """
import sys
import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt64

class Ending(Node):
    def __init__(self, name, last):
        super().__init__(name)
        self.last = int(last)
        self.publisher = self.create_publisher(UInt64, f'{name}/heard', 10)
        self.create_subscription(UInt64, 'number', self.on_number, 10)

    def on_number(self, number):
        self.publisher.publish(number)
        if number.data == self.last:
            raise SystemExit

rclpy.init()
rclpy.spin(Ending(*sys.argv[1:]))
"""


def test_what_the_others_had_begun_is_no_event_if_the_run_ends_before(tmp_path: Path) -> None:
    (tmp_path / "ending.py").write_text(ENDING)
    (tmp_path / "source.py").write_text(SOURCE)
    digests = []
    for parallel in ("false", "true"):
        (tmp_path / "job.yaml").write_text(
            f"parallel: {parallel}\n"
            "nodes:\n"
            "  - node: source:Source\n"
            "  - {script: ending.py, isolated: true, required: true, arguments: [a, '4']}\n"
            "  - {script: ending.py, isolated: true, arguments: [b, '4']}\n"
            "  - {script: ending.py, isolated: true, arguments: [c, '-1']}\n"
        )
        result = run(load_job(tmp_path / "job.yaml"), tmp_path / f"{parallel}.mcap")
        assert result.error is None
        assert "has ended" in result.stop_reason
        digests.append((result.digest, result.events))
    assert digests[0] == digests[1]
