"""A participant without a client library takes part in a run, beside rclpy nodes and alone."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.interface import MessageType, ServiceType

UINT64 = MessageType("std_msgs/msg/UInt64", lambda: ("uint64 data\n", "RIHS01_" + 64 * "a"))
TRIGGER = ServiceType(
    "std_srvs/srv/Trigger",
    MessageType("std_srvs/srv/Trigger_Request"),
    MessageType("std_srvs/srv/Trigger_Response"),
)
HEADER = b"\x00\x01\x00\x00"


class Stranger:
    """Doubles what it hears, answers a service, calls another one, and has a timer."""

    def __init__(self, domain: Domain, fails_at: int | None = None) -> None:
        self.domain = domain
        self.fails_at = fails_at
        self.node = domain.join("stranger")
        self.heard: list[int] = []
        self.answers: list[bytes] = []
        self.doubled = domain.publisher(self.node, "/doubled", UINT64)
        domain.subscription(self.node, "/count", UINT64, self.on_count)
        domain.service(self.node, "/how_many", TRIGGER, self.how_many)
        self.client = domain.client(self.node, "/reset", TRIGGER)
        domain.timer(self.node, 350_000_000, self.on_timer)

    def on_count(self, data: bytes) -> None:
        (count,) = struct.unpack("<Q", data[4:])
        if count == self.fails_at:
            raise ValueError(f"{count} is too much")
        self.heard.append(count)
        self.doubled.send(HEADER + struct.pack("<Q", 2 * count))

    def how_many(self, request: bytes) -> bytes:
        text = f"{len(self.heard)}".encode() + b"\0"
        return HEADER + struct.pack("<?xxxI", True, len(text)) + text

    def on_timer(self) -> None:
        self.client.call(HEADER + b"\0", self.answers.append)


JOBS: dict[str, dict[str, Any]] = {
    "plain": {},
    "delayed": {"delay": {"default": {"uniform": {"min": "1ms", "max": "30ms"}}}},
    "ordered": {
        "policy": {"order": "permutation"},
        "execution": {"nodes": {"/stranger": {"constant": "20ms"}}},
        "executors": [{"nodes": ["*"], "workers": 1}],
    },
}


def run(
    path: Path, options: dict[str, Any], *, fails_at: int | None = None
) -> tuple[Any, Any, Stranger]:
    """Run the stranger beside an rclpy node that counts; return result, rclpy node, stranger."""
    from rclpy.node import Node
    from std_msgs.msg import UInt64
    from std_srvs.srv import Trigger

    from rsltrace import Job, NodeSpec, StopSpec
    from rsltrace.run.session import RunSession
    from rsltrace.trace.model.event import EventKind

    class Counter(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("counter")
            self.count = self.resets = 0
            self.doubled: list[int] = []
            self.many: list[str] = []
            self.seen: dict[str, Any] = {}
            self.publisher = self.create_publisher(UInt64, "count", 10)
            self.create_subscription(UInt64, "doubled", self.on_doubled, 10)
            self.create_service(Trigger, "reset", self.on_reset)
            self.asks = self.create_client(Trigger, "how_many")
            self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            self.count += 1
            self.publisher.publish(UInt64(data=self.count))
            if self.count == 5:
                self.asks.call_async(Trigger.Request()).add_done_callback(
                    lambda future: self.many.append(future.result().message)
                )
                self.look()

        def look(self) -> None:
            by = self.get_publisher_names_and_types_by_node("stranger", "/")
            (info,) = self.get_publishers_info_by_topic("/doubled")
            self.seen = {
                "nodes": self.get_node_names(),
                "publishers": by,
                "subscriptions": self.get_subscriber_names_and_types_by_node("stranger", "/"),
                "services": self.get_service_names_and_types_by_node("stranger", "/"),
                "clients": self.get_client_names_and_types_by_node("stranger", "/"),
                "info": (info.node_name, info.topic_type, info.qos_profile.depth),
                "hash": bytes(info.topic_type_hash.value).hex(),
                "served": self.asks.service_is_ready(),
                "matched": self.publisher.get_subscription_count(),
            }

        def on_doubled(self, message: Any) -> None:
            self.doubled.append(message.data)

        def on_reset(self, request: Any, response: Any) -> Any:
            self.resets += 1
            response.message = f"reset {self.resets}"
            return response

    job = Job(nodes=[NodeSpec(node=Counter)], stop=StopSpec(duration=1), seed=7, **options)
    with RunSession(job, path, force=True) as session:
        session.begin()
        made: list[Stranger] = []
        world = session.world
        world.run_outside(
            "a stranger joins",
            EventKind.CONSTRUCT,
            lambda: made.append(Stranger(world.domain, fails_at)),
        )
        (counter,) = world.all_nodes()
        session.go_on()
        return session.finish(), counter, made[0]


@pytest.mark.few(1)
@pytest.mark.ros
@pytest.mark.parametrize("name", JOBS)
def test_it_talks_with_rclpy_nodes_and_the_digest_is_the_same_each_time(
    name: str, tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    result, counter, stranger = run(tmp_path / "a.mcap", JOBS[name])
    assert stranger.heard[:8] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert counter.doubled[:8] == [2, 4, 6, 8, 10, 12, 14, 16]
    assert counter.many in (["4"], ["5"])
    assert [answer[12:-1] for answer in stranger.answers] == [b"reset 1", b"reset 2"]
    again, _, _ = run(tmp_path / "b.mcap", JOBS[name])
    assert again.digest == result.digest
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


@pytest.mark.long
@pytest.mark.ros
def test_rclpy_nodes_see_it_in_the_graph(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    _, counter, _ = run(tmp_path / "run.mcap", {})
    trigger, number = ["std_srvs/srv/Trigger"], ["std_msgs/msg/UInt64"]
    assert counter.seen == {
        "nodes": ["counter", "stranger"],
        "publishers": [("/doubled", number)],
        "subscriptions": [("/count", number)],
        "services": [("/how_many", trigger)],
        "clients": [("/reset", trigger)],
        "info": ("stranger", "std_msgs/msg/UInt64", 0),  # the depth is not discovered
        "hash": 64 * "a",
        "served": True,
        "matched": 1,
    }


@pytest.mark.long
@pytest.mark.ros
def test_its_callbacks_are_traced_like_any_others(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    from rsltrace import Trace

    run(tmp_path / "run.mcap", {})
    with Trace.open(tmp_path / "run.mcap") as trace:
        own = {e.id: e for e in trace.entities.values() if trace.node_of(e).name == "/stranger"}
        assert [(e.kind.label, e.name, e.type) for e in own.values()] == [
            ("node", "/stranger", ""),
            ("publisher", "/doubled", "std_msgs/msg/UInt64"),
            ("subscription", "/count", "std_msgs/msg/UInt64"),
            ("service", "/how_many", "std_srvs/srv/Trigger"),
            ("client", "/reset", "std_srvs/srv/Trigger"),
            ("timer", "Stranger.on_timer", ""),
        ]
        events = [trace.event(index) for index in range(trace.event_count)]
        kinds = [event.kind.label for event in events if event.entity in own]
        assert kinds.count("subscription") == len(list(trace.messages("/doubled"))) == 10
        assert (kinds.count("service"), kinds.count("timer"), kinds.count("client")) == (1, 2, 2)
        heard = next(event for event in events if event.entity in own and event.input_hash)
        assert trace.entities[events[heard.cause_event].entity].name.endswith("Counter.tick")
        sent = [trace.decode("/doubled", data).data for _, _, data in trace.messages("/doubled")]
        assert sent == [2 * count for count in range(1, 11)]


@pytest.mark.long
@pytest.mark.ros
def test_what_it_raises_ends_the_run_and_is_in_the_trace(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    result, counter, stranger = run(tmp_path / "run.mcap", {}, fails_at=4)
    assert stranger.heard == [1, 2, 3]
    assert counter.doubled == [2, 4, 6]
    error: Any = result.error
    assert str(error) == (
        "/stranger: subscription /count, at simulated time 0.400000000 s raised ValueError: "
        "4 is too much"
    )
    assert (error.node, error.entity) == ("/stranger", "/stranger: subscription /count")
    assert "in on_count" in error.traceback_text
    assert "rsltrace/simulation/middleware" not in error.traceback_text


ALONE = """
import struct, sys
from rsltrace.simulation.loop.loop import EventLoop
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.loop.timer_queue import timer_queue
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.interface import MessageType
from rsltrace.simulation.middleware.qos.policies import DEFAULT_QOS, Durability
from dataclasses import replace

loop = EventLoop(start_ns=0, timers=timer_queue("creation"))
domain = Domain(loop)
sends, hears = domain.join("sends", "/a"), domain.join("hears")
text = MessageType("std_msgs/msg/UInt8")
kept = replace(DEFAULT_QOS, durability=Durability.TRANSIENT_LOCAL)
publisher = domain.publisher(sends, "/topic", text, kept)
publisher.send(b"early")
heard = []

def on_message(data):
    heard.append((loop.now_ns, data))
    if len(heard) == 3:
        domain.leave(sends)

domain.timer(sends, 10, lambda: publisher.send(b"tick"))
domain.subscription(hears, "/topic", text, on_message, kept)
loop.run()
print(loop.stopped.reason, heard, [node.fully_qualified_name for node in domain.graph.nodes])
print(domain.graph.topic_names_and_types(), loop.events)
print(sorted({"rclpy", "greenlet", "rosidl_parser"} & set(sys.modules)))
"""


@pytest.mark.long
def test_without_rclpy_it_lives_in_a_domain_of_its_own() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ALONE], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.stdout.splitlines() == [
        "nothing left to do [(0, b'early'), (10, b'tick'), (20, b'tick')] ['/hears']",
        "[('/topic', ['std_msgs/msg/UInt8'])] 5",
        "[]",
    ], done.stderr
