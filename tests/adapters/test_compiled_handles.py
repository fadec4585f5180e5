"""Compiled handles of topics run callbacks and publish as the Python that they replace."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import UInt64

from rsltrace import NodeSpec
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle, SubscriptionHandle
from rsltrace.compiled import core
from rsltrace.errors import RunError

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(core is None, reason="no compiler has built rsltrace._core"),
]


class Changes(Node):
    """Subscribes in every way there is, and changes its subscriptions in their callbacks."""

    def __init__(self, log: list[Any]) -> None:
        super().__init__("changes")
        self.log = log
        self.out = self.create_publisher(UInt64, "numbers", 10)
        self.again = self.create_publisher(UInt64, "again", 10)
        own = ReentrantCallbackGroup()
        subscribe = self.create_subscription
        self.plain = subscribe(UInt64, "numbers", self.first, 10)
        subscribe(UInt64, "numbers", lambda data: log.append(data), 10, raw=True)
        self.gone = subscribe(UInt64, "numbers", self.leave, 10, callback_group=own)
        subscribe(UInt64, "numbers", self.slowly, 10, callback_group=own)
        subscribe(UInt64, "numbers", self.informed, 10)
        subscribe(UInt64, "again", self.collect, 2)
        self.create_timer(0.1, self.tick)
        self.ticks = 0

    def tick(self) -> None:
        self.ticks += 1
        for _ in range(3):
            self.out.publish(UInt64(data=self.ticks))
        for wrong in (None, UInt64):
            try:
                self.out.handle.publish(wrong)
            except Exception as error:
                self.log.append((type(error), str(error)))

    def first(self, message: UInt64) -> None:
        self.log.append(("first", message.data))
        self.plain.callback = self.second
        self.again.publish(message)

    def second(self, message: UInt64) -> None:
        self.log.append(("second", message.data))
        self.plain.callback = self.first
        if message.data % 3 == 0:
            self.plain.raw, self.plain.callback = True, self.data

    def data(self, data: Any) -> None:
        self.log.append(("data", type(data)))
        self.plain.raw, self.plain.callback = False, self.first

    def leave(self, message: UInt64) -> None:
        self.log.append(("leave", message.data))
        if message.data == 3:
            self.destroy_subscription(self.gone)
            self.gone = None

    async def slowly(self, message: UInt64) -> None:
        self.log.append(("slowly", message.data))

    def informed(self, message: UInt64, info: Any) -> None:
        self.log.append(("informed", message.data, info))

    def collect(self, message: UInt64) -> None:
        self.log.append(("collect", message.data, sys.exc_info()[0]))
        gc.collect()


def in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SubscriptionHandle, "dispatch", SubscriptionHandle.dispatch_any)
    monkeypatch.setattr(PublisherHandle, "publish", PublisherHandle.publish_any)


def _turn_by_turn(node: Node) -> None:
    while rclpy.ok():
        rclpy.spin_once(node)


def _in_threads(node: Node) -> None:
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    executor.spin()


@pytest.mark.parametrize("spin", [None, rclpy.spin, _turn_by_turn, _in_threads])
def test_callbacks_run_the_same(
    simulate: Any, monkeypatch: pytest.MonkeyPatch, spin: Callable[[Node], None] | None
) -> None:
    def run() -> tuple[list[Any], str]:
        log: list[Any] = []

        def main() -> None:
            rclpy.init()
            assert spin is not None
            spin(Changes(log))

        node = NodeSpec(node=lambda: Changes(log)) if spin is None else NodeSpec(main=main)
        result = simulate(node, duration=1).result
        return log, result.digest

    compiled = run()
    assert {"first", "second", "data", "leave", "slowly", "informed", "collect"} <= {
        entry[0] for entry in compiled[0] if isinstance(entry, tuple)
    }
    in_python(monkeypatch)
    assert run() == compiled


@pytest.mark.parametrize(
    "error",
    [ValueError("no"), KeyboardInterrupt(), SystemExit(3), StopIteration(), GeneratorExit()],
)
def test_what_a_callback_raises_ends_the_run_the_same(
    simulate: Any, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    class Raises(Node):
        def __init__(self) -> None:
            super().__init__("raises")
            self.out = self.create_publisher(UInt64, "numbers", 10)
            self.create_subscription(UInt64, "numbers", self.hear, 10)
            self.create_timer(0.1, lambda: self.out.publish(UInt64(data=7)))

        def hear(self, message: UInt64) -> None:
            try:
                {}[message.data]
            except KeyError:
                raise error  # noqa: B904

    def run() -> Any:
        error.__context__ = error.__traceback__ = None
        try:
            result = simulate(Raises, duration=1).result
        except RunError as failure:
            return str(failure), type(error.__context__)
        return result.digest, result.exit_code, type(error.__context__)

    compiled = run()
    in_python(monkeypatch)
    assert run() == compiled
    assert compiled[-1] is KeyError


@pytest.mark.parametrize(
    "field", ["_deserialize", "entity_id", "dispatcher", "_callback", "queue", "own_group", "node"]
)
def test_a_handle_that_has_lost_a_field_does_not_crash(simulate: Any, field: str) -> None:
    class Breaks(Node):
        def __init__(self) -> None:
            super().__init__("breaks")
            self.out = self.create_publisher(UInt64, "numbers", 10)
            self.sub = self.create_subscription(UInt64, "numbers", self.hear, 10)
            self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            self.out.publish(UInt64())
            self.out.publish(UInt64())

        def hear(self, message: UInt64) -> None:
            delattr(self.sub.handle, field)

    with pytest.raises((AttributeError, RunError), match=field):
        simulate(Breaks, duration=1)


def test_a_publisher_that_has_lost_a_field_does_not_crash(simulate: Any) -> None:
    refused: list[str] = []

    class Breaks(Node):
        def __init__(self) -> None:
            super().__init__("breaks")
            self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            for field in ("_serialize", "_sites", "_count", "dispatcher", "entity_id"):
                handle = self.create_publisher(UInt64, "numbers", 10).handle
                kept = getattr(handle, field)
                delattr(handle, field)
                try:
                    handle.publish(UInt64())
                except AttributeError as error:
                    refused.append(str(error))
                except TypeError:
                    refused.append(field)
                setattr(handle, field, kept)

    simulate(Breaks, duration=0.1)
    assert len(refused) == 5
