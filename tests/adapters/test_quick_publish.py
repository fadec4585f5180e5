"""Publishing quickly is publishing as rclpy does it: what arrives, what is refused."""

from __future__ import annotations

from typing import Any

import pytest
from rcl_interfaces.msg import ParameterEvent
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from std_msgs.msg import String, UInt64

from rsltrace.adapters.rclpy.boundary.installation import quick_publish

pytestmark = pytest.mark.ros

RCLPYS_OWN = Publisher.publish


class Publishes(Node):
    """Publishes in every way there is, and notes what comes of it."""

    def __init__(self, log: list[Any]) -> None:
        super().__init__("publishes")
        self.log = log
        self.own = self.create_publisher(UInt64, "numbers", 10)
        self.gone = self.create_publisher(UInt64, "gone", 10)
        self.create_subscription(UInt64, "numbers", lambda message: log.append(message.data), 10)
        self.create_timer(1.0, self.tick)

    def tick(self) -> None:
        derived = type("Derived", (UInt64,), {"__slots__": []})
        self.destroy_publisher(self.gone)
        for publisher, what in (
            (self.own, UInt64(data=1)),
            (self.own, serialize_message(UInt64(data=2))),
            (self.own, derived(data=3)),
            (self.own, String(data="4")),
            (self.own, None),
            (self.own, b"5"),
            (self.gone, UInt64(data=6)),
            (self.gone, serialize_message(UInt64(data=7))),
        ):
            try:
                publisher.publish(what)
            except Exception as error:
                self.log.append((type(error), str(error)))
        Publisher.publish(self.own, UInt64(data=8))


def run(simulate: Any) -> tuple[list[Any], str]:
    log: list[Any] = []
    result = simulate(lambda: Publishes(log), duration=1).result
    return log, result.digest


def test_all_is_as_with_rclpys_own_method(simulate: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = run(simulate)
    assert Publisher.publish is RCLPYS_OWN
    # A class that derives from rclpy's has its method, whatever becomes of that during the run.
    monkeypatch.setattr(
        Node, "create_publisher", _with_rclpys_own(Node.create_publisher), raising=True
    )
    assert run(simulate) == quick
    numbers = [one for one in quick[0] if isinstance(one, int)]
    assert numbers[:2] == [1, 2]
    assert numbers[-1] == 8
    assert sum(isinstance(one, tuple) for one in quick[0]) >= 5


def _with_rclpys_own(create: Any) -> Any:
    class Slow(Publisher):  # type: ignore[misc]
        publish = RCLPYS_OWN

    def create_publisher(self: Any, *arguments: Any, **options: Any) -> Any:
        publisher = create(self, *arguments, **options)
        publisher.__class__ = Slow
        return publisher

    return create_publisher


def test_a_run_has_the_quick_method_and_puts_rclpys_own_back(simulate: Any) -> None:
    during: list[Any] = []

    class Looks(LifecycleNode):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("looks")
            during.append(Publisher.publish)
            publisher = self.create_lifecycle_publisher(UInt64, "numbers", 10)
            publisher.publish(UInt64(data=1))  # which is not active
            publisher.on_activate(None)
            publisher.publish(UInt64(data=2))

    recorded = simulate(Looks, duration=1)
    assert during[0] is not RCLPYS_OWN
    assert Publisher.publish is RCLPYS_OWN
    with recorded.trace() as trace:
        assert len(list(trace.messages("/numbers"))) == 1


def test_who_patches_publish_is_heard(simulate: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[Any] = []

    def patched(self: Any, message: Any) -> None:
        heard.append(message)
        RCLPYS_OWN(self, message)

    monkeypatch.setattr(Publisher, "publish", patched)
    log, _ = run(simulate)
    assert Publisher.publish is patched
    assert len([message for message in heard if not isinstance(message, ParameterEvent)]) == 9
    assert log
    with quick_publish():
        assert Publisher.publish is patched


def test_a_publisher_over_dds_is_left_to_rclpy() -> None:
    """Another thread of this process may have one, whose handle knows nothing of us."""
    published: list[Any] = []

    class Handle:
        def __enter__(self) -> None:
            published.append("entered")

        def __exit__(self, *error: object) -> None:
            published.append("left")

        def publish(self, message: Any) -> None:
            published.append(message)

    events = type("Events", (), {"create_event_handlers": lambda *_: []})()
    publisher = Publisher(Handle(), UInt64, "/numbers", None, events, None)
    message = UInt64(data=1)
    with quick_publish():
        publisher.publish(message)
    assert published == ["entered", message, "left"]
