"""Compiled handles run callbacks and publish as the Python that they replace."""

from __future__ import annotations

import contextlib
import gc
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import UInt64

from rsltrace import NodeSpec
from rsltrace.adapters.rclpy.handles.pubsub import PublisherHandle, SubscriptionHandle
from rsltrace.adapters.rclpy.handles.timers import TimerHandle
from rsltrace.compiled import core
from rsltrace.errors import RunError
from rsltrace.simulation.loop.loop import EventLoop

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


def in_python(monkeypatch: pytest.MonkeyPatch) -> list[SubscriptionHandle]:
    """Leave the compiled methods; return the subscriptions that are dispatched without them."""
    dispatched: list[SubscriptionHandle] = []

    def dispatch(handle: SubscriptionHandle) -> None:
        dispatched.append(handle)
        handle.dispatch_any()

    # A compiled loop does not look up a method of a class that it knows.
    monkeypatch.setattr(EventLoop, "run_ready", EventLoop.python_run_ready)
    monkeypatch.setattr(EventLoop, "run_arrivals", EventLoop.python_run_arrivals)
    monkeypatch.setattr(SubscriptionHandle, "dispatch", dispatch)
    monkeypatch.setattr(PublisherHandle, "publish", PublisherHandle.publish_any)
    monkeypatch.setattr(TimerHandle, "dispatch", TimerHandle.dispatch_any)
    return dispatched


class ChangesTimers(Node):
    """Has timers of every kind, and changes them in their callbacks."""

    def __init__(self, log: list[Any]) -> None:
        super().__init__("changes_timers")
        self.log = log
        own = ReentrantCallbackGroup()
        self.plain = self.create_timer(0.01, self.first)
        self.other = self.create_timer(0.015, lambda: log.append("other"))
        self.blocks = self.create_timer(0.02, self.late, callback_group=own)
        self.gone = self.create_timer(0.01, self.leave)
        self.create_timer(0.03, self.slowly)
        self.create_timer(0.03, partial(log.append, "partial"), callback_group=own)
        self.create_timer(0.0, self.always).cancel()
        self.count = 0

    def say(self, what: str) -> None:
        self.count += 1
        self.log.append(
            (what, self.get_clock().now().nanoseconds, self.plain.time_until_next_call())
        )

    def first(self) -> None:
        self.say("first")
        self.plain.callback = self.second
        if self.count % 3 == 0:
            self.other.reset()

    def second(self) -> None:
        self.say("second")
        self.plain.callback = self.first
        self.plain.timer_period_ns = 10_000_000 + self.count * 100_000
        if self.count % 5 == 0:
            self.other.cancel()
        elif self.other.is_canceled():
            self.other.reset()
        self.plain.handle.call_timer()

    def late(self) -> None:
        self.say("late")
        time.sleep(0.013)
        gc.collect()

    def leave(self) -> None:
        self.say("leave")
        if self.count > 20:
            self.destroy_timer(self.gone)

    def always(self) -> None:
        self.say("always")

    async def slowly(self) -> None:
        self.say("slowly")


def _turn_by_turn(node: Node) -> None:
    while rclpy.ok():
        rclpy.spin_once(node)


def _in_threads(node: Node) -> None:
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    executor.spin()


@pytest.mark.parametrize("spin", [None, rclpy.spin, _turn_by_turn, _in_threads])
@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (Changes, {"first", "second", "data", "leave", "slowly", "informed", "collect"}),
        (ChangesTimers, {"first", "second", "late", "leave", "slowly"}),
    ],
)
def test_callbacks_run_the_same(
    simulate: Any,
    monkeypatch: pytest.MonkeyPatch,
    spin: Callable[[Node], None] | None,
    kind: Callable[[list[Any]], Node],
    expected: set[str],
) -> None:
    def run() -> tuple[list[Any], str]:
        log: list[Any] = []

        def main() -> None:
            rclpy.init()
            assert spin is not None
            spin(kind(log))

        node = NodeSpec(node=lambda: kind(log)) if spin is None else NodeSpec(main=main)
        result = simulate(node, duration=1).result
        return log, result.digest

    compiled = run()
    assert expected <= {entry[0] for entry in compiled[0] if isinstance(entry, tuple)}
    dispatched = in_python(monkeypatch)
    assert run() == compiled
    assert bool(dispatched) is (kind is Changes)


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
    dispatched = in_python(monkeypatch)
    assert run() == compiled
    assert dispatched
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


@pytest.mark.parametrize(
    ("part", "field"),
    [
        ("handle", "entity_id"),
        ("handle", "dispatcher"),
        ("handle", "_callback"),
        ("handle", "own_group"),
        ("handle", "state"),
        ("state", "deadline_ns"),
        ("state", "period_ns"),
        ("state", "order"),
        ("queue", "_heap"),
    ],
)
def test_a_timer_that_has_lost_a_field_does_not_crash(simulate: Any, part: str, field: str) -> None:
    class Breaks(Node):
        def __init__(self) -> None:
            super().__init__("breaks")
            self.timer = self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            handle = self.timer.handle
            queue = handle.dispatcher.loop.timers
            delattr({"handle": handle, "state": handle.state, "queue": queue}[part], field)

    missing = f"{field}|a part of the run is missing"
    with pytest.raises((AttributeError, RunError, TypeError), match=missing):
        simulate(Breaks, duration=1)


@pytest.mark.parametrize("wrong", [None, [], [None], [(1, 2, 3)], [(1, 2, None)]])
def test_a_queue_of_timers_that_is_none_does_not_crash(simulate: Any, wrong: Any) -> None:
    class Breaks(Node):
        def __init__(self) -> None:
            super().__init__("breaks")
            self.timer = self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            queue = self.timer.handle.dispatcher.loop.timers
            first = queue._heap[0]
            queue._heap = wrong if wrong is None else [first, *wrong]

    with contextlib.suppress(Exception):
        simulate(Breaks, duration=1)


def test_a_timer_whose_objects_somebody_else_holds_does_not_crash(simulate: Any) -> None:
    held: list[Any] = []

    class Held(Node):
        def __init__(self) -> None:
            super().__init__("held")
            self.timer = self.create_timer(0.1, lambda: None)
            group = self.timer.callback_group

            def look(timer: Any) -> Any:
                held.append(gc.get_objects())
                return group

            looking = property(look, lambda timer, value: None)
            self.timer.__class__ = type("Looking", (type(self.timer),), {"callback_group": looking})

    with contextlib.suppress(Exception):
        simulate(Held, duration=0.3)
    assert held


def test_a_queue_that_is_replaced_while_it_is_looked_at_does_not_crash(simulate: Any) -> None:
    heard: list[Any] = []

    class Replaces(Node):
        def __init__(self) -> None:
            super().__init__("replaces")
            self.out = self.create_publisher(UInt64, "numbers", 10)
            self.sub = self.create_subscription(UInt64, "numbers", heard.append, 10)
            handle, group = self.sub.handle, self.sub.callback_group

            def look(sub: Any) -> Any:
                if heard and handle.queue:
                    handle.queue = list(handle.queue)
                return group

            looking = property(look, lambda sub, value: None)
            self.sub.__class__ = type("Looking", (type(self.sub),), {"callback_group": looking})
            self.create_timer(0.1, lambda: self.out.publish(UInt64()))

    with pytest.raises((AttributeError, RunError), match="'list' object has no attribute"):
        simulate(Replaces, duration=1)
    assert heard


FIELDS = ("_serialize", "_sites", "_count", "_output_kind", "dispatcher", "entity_id")


def test_a_publisher_that_has_lost_a_field_does_not_crash(simulate: Any) -> None:
    refused: list[str] = []

    class Breaks(Node):
        def __init__(self) -> None:
            super().__init__("breaks")
            self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            for field in FIELDS:
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
    assert len(refused) == len(FIELDS)
