"""Wait sets of user code (such as ``rclpy.wait_for_message``), and waitables that users write.

Executors do not use wait sets. A wait set watches its entities only while it waits, so that other
entities pay nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from functools import partialmethod
from types import FrameType
from typing import Any

from rsltrace.adapters.rclpy.concurrency.blocking_calls import SimEvent
from rsltrace.adapters.rclpy.concurrency.tasks import executor_of, set_executor, start_coroutine
from rsltrace.adapters.rclpy.handles.context import ContextHandle
from rsltrace.adapters.rclpy.handles.destroyable import Handle
from rsltrace.adapters.rclpy.handles.entity_handle import EVENTS, Alarm
from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.guard.frames import code_of
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.trace.model.event import NO_EVENT, EventKind


class WaitSetHandle(Handle):
    """Stands in for ``_rclpy.WaitSet``; its size is not fixed."""

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
        self._runtime = context.runtime
        self._context = context
        self._entities: dict[str, list[Any]] = {}
        self._found: dict[str, list[bool]] = {}
        self.clear_entities()

    def clear_entities(self) -> None:
        self._entities = {kind: [] for kind in _IS_READY}
        self._found = {kind: [] for kind in _IS_READY}

    def _add(self, kind: str, handle: Any) -> int:
        """Add an entity; return the index for ``is_ready``."""
        entities = self._entities[kind]
        entities.append(handle)
        return len(entities) - 1

    add_subscription = partialmethod(_add, "subscription")
    add_guard_condition = partialmethod(_add, "guard_condition")
    add_timer = partialmethod(_add, "timer")
    add_client = partialmethod(_add, "client")
    add_service = partialmethod(_add, "service")
    add_event = partialmethod(_add, "event")

    def is_ready(self, kind: str, index: int) -> bool:
        """Return whether the last wait found an entity ready."""
        found = self._found[kind]
        if index >= len(self._entities[kind]):
            raise IndexError(f"the wait set has no {kind} {index}")
        return index < len(found) and found[index]

    def get_ready_entities(self, kind: str) -> list[int]:
        """Return the pointers of the entities that the last wait found ready."""
        pairs = zip(self._entities[kind], self._found[kind], strict=False)
        return [handle.pointer for handle, found in pairs if found]

    def wait(self, timeout_ns: int) -> None:
        """Wait in simulated time until something is ready; forever if negative."""
        if not self._look() and timeout_ns:
            runtime = self._runtime
            until_ns = None if timeout_ns < 0 else runtime.loop.now_ns + timeout_ns
            news = SimEvent(runtime, self._wanted())
            with self.watched(news.set):
                while not self._look() and (until_ns is None or runtime.loop.now_ns < until_ns):
                    news.clear()
                    news.wait_ns(self._patience_ns(until_ns))
        for guard, found in zip(
            self._entities["guard_condition"], self._found["guard_condition"], strict=True
        ):
            if found:
                guard.take_trigger()

    def members(self) -> list[Any]:
        """Return the entities, kind by kind."""
        return [handle for entities in self._entities.values() for handle in entities]

    @contextmanager
    def watched(self, alarm: Alarm) -> Iterator[None]:
        """Call ``alarm`` whenever something arrives for an entity, within the ``with`` block."""
        with ExitStack() as stack:
            for kind, entities in self._entities.items():
                for handle in entities:
                    stack.enter_context(_WATCH[kind](handle, alarm))
            yield

    def ready_now(self) -> list[tuple[str, Any]]:
        """Return the ready entities, each with its kind."""
        return [
            (kind, handle)
            for kind, entities in self._entities.items()
            for handle in entities
            if _is_ready(kind, handle)
        ]

    def _look(self) -> bool:
        """Look for ready entities; return whether there are any."""
        self._found = {
            kind: [_is_ready(kind, handle) for handle in entities]
            for kind, entities in self._entities.items()
        }
        return any(any(found) for found in self._found.values())

    def _patience_ns(self, until_ns: int | None) -> int | None:
        """Return the time until the next timer is due, or ``until_ns`` if that is sooner."""
        now_ns = self._runtime.loop.now_ns
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


def _is_ready(kind: str, handle: Any) -> bool:
    return not handle.destroyed and _IS_READY[kind](handle)


class _AlarmedQueue(deque[Any]):
    """A queue that calls ``alarm`` for each arrival."""

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


_WATCH: dict[str, Callable[[Any, Alarm], Any]] = {
    "subscription": _watch_queue,
    "guard_condition": _watch_triggers,
    "timer": lambda handle, alarm: nullcontext(),  # it is known in advance when one is due
    "client": _watch_queue,
    "service": _watch_queue,
    "event": _watch_triggers,
}


# Waitables of user code (``node.add_waitable``) add their entities to a wait set once, and are
# ready whenever one of these is. rclpy's own (actions, QoS events) have handles instead.

OWN_WAITABLES = (*EVENTS, "_handle", "_client_handle")
"""Attributes by which rclpy's own waitables hold their handles."""

_KINDS = {
    "subscription": EventKind.SUBSCRIPTION,
    "guard_condition": EventKind.GUARD_CONDITION,
    "timer": EventKind.TIMER,
    "client": EventKind.CLIENT,
    "service": EventKind.SERVICE,
    "event": EventKind.QOS_EVENT,
}


class UserWaitable:
    """A waitable of user code; ``wrapper`` is the user's object."""

    def __init__(self, node: NodeHandle, waitable: Any) -> None:
        self.runtime = node.runtime
        self.node = node
        self.wrapper = waitable
        self.entity_id = node.entity_id
        self._set = WaitSetHandle(0, 0, 0, 0, 0, 0, node.context)
        self._watching = ExitStack()
        self._queued = self._closed = False
        self._cause = (NO_EVENT, 0)
        waitable.add_to_wait_set(self._set)
        for handle in self._set.members():
            handle.node = handle.node or node
        self._watching.enter_context(self._set.watched(self.trigger))
        self._look_again()

    def trigger(self) -> None:
        if not self._queued and not self._closed:
            self._queued = True
            self._cause = (self.runtime.loop.events, 0)
            self.runtime.loop.ready.append(self)

    def _look_again(self) -> None:
        """Trigger it if it is ready, or when its next timer is due."""
        loop = self.runtime.loop
        if self._set.ready_now():
            self.trigger()
            return
        patience_ns = self._set._patience_ns(None)
        if patience_ns is not None:
            loop.schedule(loop.now_ns + patience_ns, self.trigger)

    def dispatch(self) -> None:
        mailbox = self.node.mailbox
        if mailbox is not None and mailbox.keeps(self):
            return
        if self._closed or self.node.destroyed:
            return
        ready = self._set.ready_now()
        if ready and self.runtime.groups.must_wait(self, self.wrapper):
            return
        self._queued = False
        if not ready:
            self._look_again()
            return
        name, handle = ready[0]
        self.entity_id = handle.entity_id
        cause, digest = self._cause, 0
        if getattr(handle, "queue", None):
            *cause, digest = handle.queue[0][handle.origin]
        here: Any = self  # has what start_coroutine needs
        start_coroutine(self.runtime, here, int(_KINDS[name]), self._execute, (), *cause, digest)

    async def _execute(self) -> None:
        """Run it as rclpy's executors do after a wait."""
        self._set.wait(0)
        waitable = self.wrapper
        if waitable.is_ready(self._set):
            data = waitable.take_data()
            set_executor(waitable, executor_of(self.runtime, self))
            await waitable.execute(data)
        if not self._closed:
            self._look_again()

    def describe(self) -> str:
        return f"{self.node.fully_qualified_name}: waitable {type(self.wrapper).__qualname__}"

    def runnable(self) -> Runnable:
        handed_over = self.node.mailbox is not None
        return on_no_executor(self.node, self.describe(), "waitable", handed_over=handed_over)

    def close(self) -> None:
        self._closed = True
        self._watching.close()


def sync_waitables(node: NodeHandle) -> None:
    """Run waitables that user code has added to a node, and stop those that it removed."""
    present: Any = ()
    if node.wrapper is not None:
        # Each subscription and publisher may have one; listing many takes long.
        present = getattr(node.wrapper, "_Node__waitables", None)
        present = list(node.wrapper.waitables) if present is None else present
    before, node.waitable_count = node.waitable_count, len(present)
    if before == len(present):
        return  # rclpy asks after each change
    for waitable in [known for known in node.user_waitables if known not in present]:
        node.user_waitables.pop(waitable).close()
    for waitable in present[0 if node.user_waitables else before :]:  # new ones are at the end
        if waitable not in node.user_waitables and _is_users(waitable):
            node.user_waitables[waitable] = UserWaitable(node, waitable)


def sync_woken(nodes: Collection[Any], caller: FrameType) -> None:
    """Call ``sync_waitables`` for the ``nodes`` that may have changed.

    A node wakes its executor after each change: then only that node is checked, so that a thousand
    nodes are not checked nine thousand times.
    """
    if code_of(caller).co_name == "_wake_executor" and (woken := caller.f_locals["self"]) in nodes:
        nodes = [woken]
    for node in nodes:
        sync_waitables(node.handle)


def _is_users(waitable: Any) -> bool:
    return not any(hasattr(waitable, name) for name in OWN_WAITABLES)


def activate_node(node: NodeHandle) -> None:
    """Run the callbacks of a node from now on."""
    for handle in _handles(node):
        if handle.wrapper is None:
            handle.node = handle.node or node
            handle.find_wrapper()
    node.dispatcher.entities.look_again(node)
    sync_waitables(node)


def deactivate_node(node: NodeHandle) -> None:
    """Stop running the callbacks of a node; received messages stay in its queues."""
    for handle in _handles(node):
        handle.deactivate()
    node.wrapper = None
    sync_waitables(node)


def _handles(node: NodeHandle) -> Iterator[Any]:
    """Yield the handles of a node's callbacks, kind by kind in creation order."""
    for lists in ("subscriptions", "timers", "clients", "services", "guards"):
        for wrapper in getattr(node.wrapper, lists):
            yield wrapper.handle
    for waitable in node.wrapper.waitables:
        for name in OWN_WAITABLES:
            handle = getattr(waitable, name, None)
            if handle is not None:
                yield from getattr(handle, "parts", [handle])
