"""Wait sets of user code: ``rclpy.wait_for_message`` uses one, and code close to rcl does.

Executors do without. Whoever waits here watches the entities for as long as the wait lasts, so that
entities which nobody waits for pay nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from rsltrace.adapters.rclpy.handles.context import ContextHandle
from rsltrace.adapters.rclpy.handles.destroyable import Handle
from rsltrace.adapters.rclpy.handles.entity_handle import Alarm
from rsltrace.adapters.rclpy.stacks.sim_event import SimEvent


class WaitSetHandle(Handle):
    """Stands in for ``_rclpy.WaitSet``. Its size is not fixed: entities are added as they come."""

    def __init__(
        self,
        subscriptions: int,
        guard_conditions: int,
        timers: int,
        clients: int,
        services: int,
        events: int,
        context: ContextHandle,
    ) -> None:
        super().__init__()
        self._stacks = context.stacks
        self._context = context
        self._entities: dict[str, list[Any]] = {}
        self._found: dict[str, list[bool]] = {}
        self.clear_entities()

    def clear_entities(self) -> None:
        """Start anew."""
        self._entities = {kind: [] for kind in _IS_READY}
        self._found = {kind: [] for kind in _IS_READY}

    def _add(self, kind: str, handle: Any) -> int:
        entities = self._entities[kind]
        entities.append(handle)
        return len(entities) - 1

    def add_subscription(self, handle: Any) -> int:
        """Wait for a message; return the index to ask with."""
        return self._add("subscription", handle)

    def add_guard_condition(self, handle: Any) -> int:
        """Wait for a trigger; return the index to ask with."""
        return self._add("guard_condition", handle)

    def add_timer(self, handle: Any) -> int:
        """Wait for a timer to be due; return the index to ask with."""
        return self._add("timer", handle)

    def add_client(self, handle: Any) -> int:
        """Wait for a response; return the index to ask with."""
        return self._add("client", handle)

    def add_service(self, handle: Any) -> int:
        """Wait for a request; return the index to ask with."""
        return self._add("service", handle)

    def add_event(self, handle: Any) -> int:
        """Wait for a QoS event; return the index to ask with."""
        return self._add("event", handle)

    def is_ready(self, kind: str, index: int) -> bool:
        """Return whether the last wait found an entity ready."""
        found = self._found[kind]
        if index >= len(self._entities[kind]):
            raise IndexError(f"the wait set has no {kind} {index}")
        return index < len(found) and found[index]

    def get_ready_entities(self, kind: str) -> list[int]:
        """Return the pointers of what the last wait found ready."""
        pairs = zip(self._entities[kind], self._found[kind], strict=False)
        return [handle.pointer for handle, found in pairs if found]

    def wait(self, timeout_ns: int) -> None:
        """Wait in simulated time until something is ready; forever if negative."""
        if not self._look() and timeout_ns:
            stacks = self._stacks
            until_ns = None if timeout_ns < 0 else stacks.loop.now_ns + timeout_ns
            news = SimEvent(stacks, self._wanted())
            with self.watched(news.set):
                while not self._look() and (until_ns is None or stacks.loop.now_ns < until_ns):
                    news.clear()
                    news.wait_ns(self._patience_ns(until_ns))
        for guard, found in zip(
            self._entities["guard_condition"], self._found["guard_condition"], strict=True
        ):
            if found:
                guard.take_trigger()

    def members(self) -> list[Any]:
        """Return the entities, in the order in which kinds and entities are looked at."""
        return [handle for entities in self._entities.values() for handle in entities]

    @contextmanager
    def watched(self, alarm: Alarm) -> Iterator[None]:
        """Within the ``with`` block, call ``alarm`` whenever something comes for an entity."""
        with ExitStack() as stack:
            for kind, entities in self._entities.items():
                for handle in entities:
                    stack.enter_context(_WATCH[kind](handle, alarm))
            yield

    def ready_now(self) -> list[tuple[str, Any]]:
        """Return the kind and the entity of whatever is ready."""
        return [
            (kind, handle)
            for kind, entities in self._entities.items()
            for handle in entities
            if not handle.destroyed and _IS_READY[kind](handle)
        ]

    def _look(self) -> bool:
        """See what is ready; return whether anything is."""
        self._found = {
            kind: [not handle.destroyed and _IS_READY[kind](handle) for handle in entities]
            for kind, entities in self._entities.items()
        }
        return any(any(found) for found in self._found.values())

    def _patience_ns(self, until_ns: int | None) -> int | None:
        """Return how long to wait at most: until the next timer is due, or the time is up."""
        now_ns = self._stacks.loop.now_ns
        limits = [timer.time_until_next_call() for timer in self._entities["timer"]]
        limits.append(None if until_ns is None else until_ns - now_ns)
        known = [limit for limit in limits if limit is not None]
        return max(min(known), 0) if known else None

    def _wanted(self) -> str:
        names = [h.describe() for k, found in self._entities.items() if k not in _UNNAMED
                 for h in found]  # fmt: skip
        return f"a wait set of {', '.join(names)}" if names else "a wait set"


_UNNAMED = ("guard_condition", "timer")

_IS_READY: dict[str, Callable[[Any], bool]] = {
    "subscription": lambda handle: bool(handle.queue),
    "guard_condition": lambda handle: handle.is_triggered(),
    "timer": lambda handle: handle.is_timer_ready(),
    "client": lambda handle: bool(handle.queue),
    "service": lambda handle: bool(handle.queue),
    "event": lambda handle: handle.has_news(),
}


class _AlarmedQueue(deque[Any]):
    """A queue that tells of what arrives."""

    alarm: Alarm

    def append(self, arrival: Any) -> None:
        super().append(arrival)
        self.alarm()


@contextmanager
def _watch_queue(handle: Any, alarm: Alarm) -> Iterator[None]:
    plain = handle.queue
    queue = _AlarmedQueue(plain, plain.maxlen)
    queue.alarm = alarm
    handle.queue = queue
    try:
        yield
    finally:
        plain.clear()
        plain.extend(queue)
        handle.queue = plain


@contextmanager
def _watch_triggers(handle: Any, alarm: Alarm) -> Iterator[None]:
    handle.alarms = (*handle.alarms, alarm)
    try:
        yield
    finally:
        handle.alarms = tuple(one for one in handle.alarms if one is not alarm)


@contextmanager
def _watch_nothing(handle: Any, alarm: Alarm) -> Iterator[None]:
    yield  # when a timer is due is known in advance


_WATCH: dict[str, Callable[[Any, Alarm], Any]] = {
    "subscription": _watch_queue,
    "guard_condition": _watch_triggers,
    "timer": _watch_nothing,
    "client": _watch_queue,
    "service": _watch_queue,
    "event": _watch_triggers,
}
