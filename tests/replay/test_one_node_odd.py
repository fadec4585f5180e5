"""One node alone, of nodes that poll, wait, call back, hear themselves or have several threads."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsltrace.job import load_job
from rsltrace.run import run
from tests.replay.test_one_node import unchanged

pytestmark = pytest.mark.ros

NODES = """
import threading, time, rclpy
from rclpy.node import Node
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import QoSProfile, DurabilityPolicy, ReliabilityPolicy
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks, PublisherEventCallbacks
from std_msgs.msg import UInt64, String, Float64
from std_srvs.srv import Trigger, SetBool
from rclpy.wait_for_message import wait_for_message

LATCH = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

class Clock(Node):
    def __init__(self, name='ticker', period=0.05):
        super().__init__(name)
        self.n = 0
        self.out = self.create_publisher(UInt64, 'tick', 10)
        self.latched = self.create_publisher(String, 'map', LATCH)
        self.latched.publish(String(data='first map'))
        self.create_timer(period, self.tick)
        self.create_service(Trigger, 'now', self.now)
    def now(self, request, response):
        response.success = True; response.message = str(self.n); return response
    def tick(self):
        self.n += 1
        self.out.publish(UInt64(data=self.n))
        if self.n % 3 == 0:
            self.out.publish(UInt64(data=1000 + self.n))
        if self.n == 7:
            self.latched.publish(String(data='second map'))

class Several(Node):
    def __init__(self):
        super().__init__('several')
        self.log = []
        g = ReentrantCallbackGroup()
        self.create_subscription(UInt64, 'tick', lambda m: self.say('a', m.data), 1)
        self.create_subscription(
            UInt64, 'tick', lambda m: self.say('b', m.data), 10, callback_group=g)
        self.create_timer(0.05, lambda: self.say('t', 0))
        self.create_timer(0.15, self.late)
        self.cli = self.create_client(Trigger, 'now', callback_group=g)
        self.out = self.create_publisher(String, 'said', 10)
        self.count = 0
    def say(self, who, x):
        pubs, subs = self.count_publishers('tick'), self.count_subscribers('said')
        self.out.publish(String(data=f'{who}{x} {pubs} {subs}'))
    def late(self):
        self.count += 1
        if self.count == 2:
            self.create_subscription(
                String, 'map', lambda m: self.get_logger().info('map ' + m.data), LATCH)
        f = self.cli.call_async(Trigger.Request())
        f.add_done_callback(
            lambda f: self.get_logger().info('now ' + f.result().message))

class Deadline(Node):
    def __init__(self):
        super().__init__('deadline')
        q = QoSProfile(depth=5, deadline=Duration(seconds=0.07))
        ev = SubscriptionEventCallbacks(deadline=self.missed, matched=self.matched)
        self.create_subscription(UInt64, 'slow', self.got, q, event_callbacks=ev)
    def missed(self, e): self.get_logger().warn(f'missed {e.total_count}')
    def matched(self, e): self.get_logger().warn(f'matched {e.current_count}')
    def got(self, m): self.get_logger().info(f'got {m.data}')

class Slow(Node):
    def __init__(self):
        super().__init__('slow')
        q = QoSProfile(depth=5, deadline=Duration(seconds=0.07))
        self.out = self.create_publisher(UInt64, 'slow', q)
        self.n = 0
        self.create_timer(0.06, self.tick)
    def tick(self):
        self.n += 1
        if self.n % 4:
            self.out.publish(UInt64(data=self.n))

class Loop(Node):
    def __init__(self):
        super().__init__('loop')
        self.out = self.create_publisher(Float64, 'loop', 10)
        self.create_subscription(Float64, 'loop', self.got, 10)
        self.create_subscription(
            UInt64, 'tick', lambda m: self.out.publish(Float64(data=float(m.data))), 10)
        self.cli = self.create_client(SetBool, 'loop_srv')
        self.create_service(SetBool, 'loop_srv', self.srv)
    def srv(self, q, a):
        a.success = q.data; return a
    def got(self, m):
        if m.data < 3000 and m.data > 1:
            self.out.publish(Float64(data=m.data * 0.5))
            future = self.cli.call_async(SetBool.Request(data=m.data > 10))
            future.add_done_callback(
                lambda f: self.get_logger().info(f'srv {f.result().success}'))

def poller():
    rclpy.init()
    node = rclpy.create_node('poller')
    got = []
    node.create_subscription(UInt64, 'tick', lambda m: got.append(m.data), 10)
    pub = node.create_publisher(String, 'polled', 10)
    while rclpy.ok():
        rclpy.spin_once(node, timeout_sec=0.02)
        pub.publish(String(data=f'{node.get_clock().now().nanoseconds} {got[-3:]}'))

def busy():
    rclpy.init()
    node = rclpy.create_node('busy')
    got = []
    node.create_subscription(UInt64, 'tick', lambda m: got.append(m.data), 10)
    pub = node.create_publisher(String, 'busy', 10)
    while rclpy.ok() and len(got) < 12:
        rclpy.spin_once(node, timeout_sec=0)
        if got and got[-1] % 2: pub.publish(String(data=f'{len(got)}'))
    time.sleep(0.1)
    pub.publish(String(data='done'))

def waiter():
    rclpy.init()
    node = rclpy.create_node('waiter')
    for i in range(4):
        ok, m = wait_for_message(UInt64, node, 'tick', time_to_wait=1.0)
        at = node.get_clock().now().nanoseconds
        node.get_logger().info(f'{ok} {m.data if ok else None} {at}')

def threaded():
    rclpy.init()
    node = rclpy.create_node('threaded')
    ex = MultiThreadedExecutor(3)
    ex.add_node(node)
    g = ReentrantCallbackGroup()
    cli = node.create_client(Trigger, 'now', callback_group=g)
    node.create_subscription(
        UInt64, 'tick', lambda m: node.get_logger().info(f'tick {m.data}'), 10, callback_group=g)
    def call():
        r = cli.call(Trigger.Request())
        node.get_logger().info(f'answer {r.message}')
        time.sleep(0.03)
        node.get_logger().info('slept')
    node.create_timer(0.1, call, callback_group=g)
    t = threading.Thread(target=ex.spin, daemon=True); t.start()
    rate = node.create_rate(20)
    try:
        while rclpy.ok():
            node.get_logger().info('main')
            rate.sleep()
    except Exception as e:
        pass
class Coroutine(Node):
    def __init__(self):
        super().__init__('coroutine')
        self.cli = self.create_client(Trigger, 'slow_srv')
        self.create_timer(0.08, self.go)
        self.k = 0
    async def go(self):
        self.k += 1
        k = self.k
        r = await self.cli.call_async(Trigger.Request())
        self.get_logger().info(f'{k}: {r.message}')
class CoroutineServer(Node):
    def __init__(self):
        super().__init__('coroutine_server')
        g = ReentrantCallbackGroup()
        self.cli = self.create_client(Trigger, 'now', callback_group=g)
        self.create_service(Trigger, 'slow_srv', self.serve, callback_group=g)
        self.k = 0
    async def serve(self, q, a):
        self.k += 1
        r = await self.cli.call_async(Trigger.Request())
        a.message = f'{self.k} {r.message}'
        return a
"""

JOB = """\
nodes:
  - node: odd:Clock
  - {node: odd:Clock, arguments: {name: other, period: 0.035}}
  - node: odd:Several
  - node: odd:Deadline
  - node: odd:Slow
  - node: odd:Loop
  - main: odd:poller
  - main: odd:busy
  - main: odd:waiter
  - main: odd:threaded
  - node: odd:Coroutine
  - node: odd:CoroutineServer
seed: 7
"""

FEATURES = {
    "plain": "",
    "delays": "delay: {default: {uniform: {min: 0ms, max: 40ms}}}\n",
    "losses": "delay: {default: {normal: {mean: 5ms, sd: 5ms}, drop: 0.2}}\n",
    "outages": "delay: {default: {constant: 1ms}, "
    "outages: [{node: /several, from: 200ms, to: 500ms}]}\n",
    "rates": "policy: rate_monotonic\n",
    "execution times": "execution: {default: {uniform: {min: 1ms, max: 9ms}}}\n",
    "shared executors": "executors: [{nodes: ['*'], workers: 2}]\n"
    "execution: {default: {constant: 3ms}}\n",
    "steps": "min_time_step: 4ms\n",
    "ties": "timer_ties: heap\n",
    "clocks": "clocks: [{node: /several, offset: -20ms, "
    "random_jumps: {every: 100ms, most: 5ms}}]\n",
}
SHORT = ("shared executors",)


def check(tmp_path: Path, feature: str, stop: str) -> None:
    (tmp_path / "odd.py").write_text(NODES)
    (tmp_path / "job.yaml").write_text(f"{JOB}{FEATURES[feature]}stop: {{{stop}}}\n")
    assert run(load_job(tmp_path / "job.yaml"), tmp_path / "run.mcap").error is None
    unchanged(tmp_path / "run.mcap", tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("feature", SHORT)
def test_odd_nodes(feature: str, tmp_path: Path) -> None:
    check(tmp_path, feature, "duration: 400ms")


@pytest.mark.long
@pytest.mark.parametrize("feature", FEATURES)
def test_odd_nodes_for_longer(feature: str, tmp_path: Path) -> None:
    check(tmp_path, feature, "duration: 3s")


@pytest.mark.long
def test_a_run_that_ends_in_the_middle_of_a_time_step(tmp_path: Path) -> None:
    check(tmp_path, "plain", "events: 333")
