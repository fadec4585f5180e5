"""QoS on simulated time where DDS cannot be asked: together with delays, outages and parameters.

What needs no delays is compared with the real DDS in ``test_qos_native.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("rclpy")

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSLivelinessPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import UInt64

from rsltrace import NodeSpec
from rsltrace.trace.model.event import EventKind

pytestmark = pytest.mark.ros

MS = 1_000_000


def now_ms(node: Node) -> int:
    return int(node.get_clock().now().nanoseconds // MS)


def qos(**limits_ms: int) -> QoSProfile:
    return QoSProfile(
        depth=10, **{name: Duration(nanoseconds=ms * MS) for name, ms in limits_ms.items()}
    )


def manual(lease_ms: int) -> QoSProfile:
    profile = qos(liveliness_lease_duration=lease_ms)
    profile.liveliness = QoSLivelinessPolicy.MANUAL_BY_TOPIC
    return profile


class Sender(Node):  # type: ignore[misc]
    """Publishes 1, 2, … at the given milliseconds."""

    def __init__(self, profile: QoSProfile, at_ms: list[int], **events: Any) -> None:
        super().__init__("sender")
        self.publisher = self.create_publisher(
            UInt64, "t", profile, event_callbacks=PublisherEventCallbacks(**events)
        )
        for number, ms in enumerate(at_ms, start=1):
            self.once(ms, lambda number=number: self.publisher.publish(UInt64(data=number)))

    def once(self, ms: int, action: Callable[[], Any]) -> None:
        def act() -> None:
            timer.cancel()
            action()

        timer = self.create_timer(ms / 1000, act)


class Receiver(Node):  # type: ignore[misc]
    def __init__(self, profile: QoSProfile) -> None:
        super().__init__("receiver")
        self.heard: list[tuple[int, int]] = []
        self.told: list[tuple[Any, ...]] = []
        events = SubscriptionEventCallbacks(
            deadline=lambda s: self.told.append(("deadline", now_ms(self), s.total_count)),
            liveliness=lambda s: self.told.append(
                ("alive", now_ms(self), s.alive_count, s.not_alive_count)
            ),
        )
        self.create_subscription(
            UInt64,
            "t",
            lambda m: self.heard.append((m.data, now_ms(self))),
            profile,
            event_callbacks=events,
        )


@pytest.fixture
def run(simulate: Callable[..., Any]) -> Callable[..., Any]:
    def go(*makers: Callable[[], Node], ms: int = 1000, **job: Any) -> Any:
        nodes: list[Any] = []

        def all_of_them() -> list[Any]:
            nodes.extend(make() for make in makers)
            return nodes

        recorded = simulate(all_of_them, duration=ms / 1000, job=job)
        return (recorded, *nodes)

    return go


def test_a_deadline_is_missed_where_the_delay_makes_a_gap(run: Any) -> None:
    profile = qos(deadline=150)
    delay = {"topics": {"/t": {"series": {"points": [["0s", "0s"], ["0.3s", "90ms"]]}}}}
    makers = (lambda: Sender(profile, [100, 200, 300]), lambda: Receiver(profile))
    _, _, receiver = run(*makers, delay=delay, ms=620)
    assert receiver.heard == [(1, 130), (2, 260), (3, 390)]
    assert receiver.told == [("deadline", 540, 1)]


def test_missed_deadlines_are_events_in_the_trace(run: Any) -> None:
    profile = qos(deadline=100)
    recorded, *_ = run(
        lambda: Sender(profile, [50], deadline=lambda status: None),
        lambda: Receiver(profile),
        ms=400,
    )
    stamps = [
        (event.stamp_ns // MS, event.kind)
        for event in recorded.events()
        if event.kind is EventKind.QOS_EVENT
    ]
    assert stamps == [(t, EventKind.QOS_EVENT) for t in (150, 150, 250, 250, 350, 350)]


def test_a_run_without_callbacks_for_deadlines_still_ends_by_itself(simulate: Any) -> None:
    profile = qos(deadline=100, liveliness_lease_duration=100)

    def pair() -> list[Node]:
        ears = Node("ears")
        ears.create_subscription(UInt64, "t", lambda m: None, profile)
        return [Sender(profile, [50]), ears]

    recorded = simulate(pair, job={})
    assert recorded.result.stop_reason == "nothing left to do"


def test_a_message_older_than_its_lifespan_is_not_delivered(run: Any) -> None:
    delay = {"topics": {"/t": {"series": {"points": [["0s", "0s"], ["0.4s", "80ms"]]}}}}
    _, _, receiver = run(
        lambda: Sender(qos(lifespan=50), [100, 200, 300, 400]),
        lambda: Receiver(QoSProfile(depth=10)),
        delay=delay,
    )
    assert receiver.heard == [(1, 120), (2, 240)]


def test_a_message_expires_while_its_callback_group_is_busy(run: Any) -> None:
    def busy() -> Node:
        node = Node("busy")
        node.heard = []
        group = MutuallyExclusiveCallbackGroup()

        def block() -> None:
            node.timer.cancel()
            node.get_clock().sleep_for(Duration(nanoseconds=200 * MS))

        node.timer = node.create_timer(0.1, block, callback_group=group)
        node.create_subscription(
            UInt64, "t", lambda m: node.heard.append(m.data), 10, callback_group=group
        )
        return node

    _, _, node = run(lambda: Sender(qos(lifespan=50), [120, 270, 280, 400]), busy)
    assert node.heard == [2, 3, 4]


def test_late_joiners_do_not_get_what_has_expired(run: Any) -> None:
    from rclpy.qos import QoSDurabilityPolicy

    latched = qos(lifespan=200)
    latched.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL

    class Late(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("late")
            self.heard: list[int] = []
            self.timer = self.create_timer(0.3, self.join)

        def join(self) -> None:
            self.timer.cancel()
            self.create_subscription(UInt64, "t", lambda m: self.heard.append(m.data), latched)

    _, _, node = run(lambda: Sender(latched, [50, 150, 250]), Late)
    assert node.heard == [2, 3]


def test_manual_liveliness_is_asserted_by_messages_and_by_hand(run: Any) -> None:
    lost: list[int] = []

    class Manual(Sender):
        def __init__(self) -> None:
            super().__init__(manual(100), [50], liveliness=self.on_lost)
            self.once(120, self.publisher.assert_liveliness)
            self.once(500, self.publisher.assert_liveliness)

        def on_lost(self, status: Any) -> None:
            lost.append(now_ms(self))

    _, _, receiver = run(Manual, lambda: Receiver(manual(150)), ms=550)
    assert lost == [220]
    assert receiver.told == [("alive", 50, 1, 0), ("alive", 270, 0, 1), ("alive", 500, 1, 0)]


@pytest.mark.parametrize(
    "outages",
    [
        [("node", "/sender", "0.2s", "0.5s")],
        [("topic", "/*", "0.3s", "0.5s"), ("node", "/sender", "0.2s", "0.35s")],
        [
            ("node", "*", "0.4s", "0.5s"),
            ("node", "*", "0.2s", "0.4s"),
            ("node", "*", "0.3s", "0.35s"),
        ],
    ],
)
def test_automatic_liveliness_ends_with_the_publisher_and_in_an_outage(
    run: Any, outages: list[tuple[str, str, str, str]]
) -> None:
    """Outages that overlap or touch are one."""

    class Leaver(Sender):
        def __init__(self) -> None:
            super().__init__(qos(liveliness_lease_duration=100), [])
            self.once(800, lambda: self.destroy_publisher(self.publisher))

    cut_off = [{what: name, "from": begin, "to": end} for what, name, begin, end in outages]
    _, _, receiver = run(
        Leaver,
        lambda: Receiver(qos(liveliness_lease_duration=100)),
        delay={"outages": cut_off},
    )
    assert receiver.told == [
        ("alive", 0, 1, 0),
        ("alive", 300, 0, 1),
        ("alive", 500, 1, 0),
        ("alive", 800, 0, 0),
    ]


def test_an_outage_hides_that_a_publisher_says_it_is_alive(run: Any) -> None:
    class Manual(Sender):
        def __init__(self) -> None:
            super().__init__(manual(110), [])
            for at_ms in (50, 150, 250, 350):
                self.once(at_ms, self.publisher.assert_liveliness)

    cut_off = [{"node": "/sender", "from": "0.14s", "to": "0.26s"}]
    _, _, receiver = run(Manual, lambda: Receiver(manual(120)), ms=400, delay={"outages": cut_off})
    assert receiver.told == [("alive", 50, 1, 0), ("alive", 170, 0, 1), ("alive", 350, 1, 0)]


def test_waiting_for_acknowledgements_takes_the_time_that_messages_take(run: Any) -> None:
    waited: list[tuple[int, bool]] = []

    class Waiter(Sender):
        def __init__(self) -> None:
            super().__init__(QoSProfile(depth=10), [])
            self.once(100, self.go)

        def go(self) -> None:
            self.publisher.publish(UInt64())
            for timeout_s in (0, 0.01, -1, -1):
                done = self.publisher.wait_for_all_acked(Duration(seconds=timeout_s))
                waited.append((now_ms(self), done))

    def deaf() -> Node:
        node = Node("deaf")
        best_effort = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(UInt64, "t", lambda m: None, best_effort)
        return node

    delay = {"links": [{"to": "/deaf", "constant": "500ms"}, {"topic": "/t", "constant": "30ms"}]}
    run(Waiter, lambda: Receiver(QoSProfile(depth=1)), deaf, delay=delay)
    assert waited == [(100, False), (110, False), (130, True), (130, True)]


def test_qos_is_overridden_by_parameters(simulate: Any) -> None:
    class Overridden(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("overridden")
            options = QoSOverridingOptions.with_default_policies()
            self.create_publisher(UInt64, "t", 10, qos_overriding_options=options)
            self.create_subscription(
                UInt64, "t", lambda m: None, 10, qos_overriding_options=options
            )

    parameters = {
        "qos_overrides./t.publisher.depth": 3,
        "qos_overrides./t.publisher.reliability": "best_effort",
        "qos_overrides./t.subscription.reliability": "best_effort",
    }
    recorded = simulate(NodeSpec(node=Overridden, parameters=parameters), duration=0.1)
    with recorded.trace() as trace:
        details = {e.kind.label: e.detail["qos"] for e in trace.entities.values() if e.name == "/t"}
    assert (details["publisher"]["depth"], details["publisher"]["reliability"]) == (
        3,
        "best_effort",
    )
    assert details["subscription"]["depth"] == 10
    assert details["subscription"]["reliability"] == "best_effort"
