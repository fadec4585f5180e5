"""Waitables that users write themselves (``node.add_waitable``), run as an executor would.

A waitable says which entities it waits for when it is asked to add them to a wait set. It is asked
once, and is ready whenever one of them is; rclpy's own waitables (actions, QoS events) have handles
that the loop dispatches without this.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack
from types import FrameType
from typing import Any

from rsltrace.adapters.rclpy.handles.node import NodeHandle
from rsltrace.adapters.rclpy.handles.wait_set import WaitSetHandle
from rsltrace.adapters.rclpy.stacks.tasks import executor_of, start_coroutine
from rsltrace.simulation.middleware.entity import Runnable, on_no_executor
from rsltrace.trace.model.event import NO_EVENT, EventKind

OWN_WAITABLES = ("_EventHandler__event", "_handle", "_client_handle")
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
    """One waitable of a node that is being run. ``wrapper`` is the user's object."""

    def __init__(self, node: NodeHandle, waitable: Any) -> None:
        self.stacks = node.stacks
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
        """Make it ready, because something has come."""
        if not self._queued and not self._closed:
            self._queued = True
            self._cause = (self.stacks.loop.events, 0)
            self.stacks.loop.ready.append(self)

    def _look_again(self) -> None:
        """Make it ready if it is already, and when the next of its timers will be due."""
        loop = self.stacks.loop
        if self._set.ready_now():
            self.trigger()
            return
        patience_ns = self._set._patience_ns(None)
        if patience_ns is not None:
            loop.schedule(loop.now_ns + patience_ns, self.trigger)

    def dispatch(self) -> None:
        """Let the waitable take what is ready and execute it, as one event."""
        mailbox = self.node.mailbox
        if mailbox is not None and mailbox.keeps(self):
            return
        if self._closed or self.node.destroyed:
            return
        ready = self._set.ready_now()
        if ready and self.stacks.groups.must_wait(self, self.wrapper):
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
        start_coroutine(self.stacks, here, int(_KINDS[name]), self._execute, (), *cause, digest)

    async def _execute(self) -> None:
        """Do what rclpy's executors do for a waitable after a wait."""
        self._set.wait(0)
        waitable = self.wrapper
        if waitable.is_ready(self._set):
            data = waitable.take_data()
            for future in waitable._futures:
                future._set_executor(executor_of(self.stacks, self))
            await waitable.execute(data)
        if not self._closed:
            self._look_again()

    def describe(self) -> str:
        """Name it for people."""
        return f"{self.node.fully_qualified_name}: waitable {type(self.wrapper).__qualname__}"

    def runnable(self) -> Runnable:
        """Describe it to a policy."""
        told = self.node.mailbox is not None
        return on_no_executor(self.node, self.describe(), "waitable", told=told)

    def close(self) -> None:
        """Run no more."""
        self._closed = True
        self._watching.close()


def sync_waitables(node: NodeHandle) -> None:
    """Run the waitables that a node's user has added, and no longer those taken away."""
    present: Any = ()
    if node.wrapper is not None:
        # Each subscription and publisher may have one: with many, even to list them takes long.
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
    """Do ``sync_waitables`` for those of ``nodes`` that may have changed.

    A node wakes its executor whenever it has made or destroyed anything: then it is only that one,
    and a thousand nodes need not be looked at nine thousand times.
    """
    if caller.f_code.co_name == "_wake_executor" and (woken := caller.f_locals["self"]) in nodes:
        nodes = [woken]
    for node in nodes:
        sync_waitables(node.handle)


def _is_users(waitable: Any) -> bool:
    return not any(hasattr(waitable, name) for name in OWN_WAITABLES)


def activate_node(node: NodeHandle) -> None:
    """Run the callbacks of a node from now on: an executor of this run has it."""
    for handle in _handles(node):
        if handle.wrapper is None:
            handle.node = handle.node or node
            handle.find_wrapper()
    node.dispatcher.entities.look_again(node)
    sync_waitables(node)


def deactivate_node(node: NodeHandle) -> None:
    """Stop running the callbacks of a node; what it has received stays in its queues."""
    for handle in _handles(node):
        handle.deactivate()
    node.wrapper = None
    sync_waitables(node)


def _handles(node: NodeHandle) -> Iterator[Any]:
    """Yield what runs callbacks of a node, in creation order of each kind."""
    for lists in ("subscriptions", "timers", "clients", "services", "guards"):
        for wrapper in getattr(node.wrapper, lists):
            yield wrapper.handle
    for waitable in node.wrapper.waitables:
        for name in OWN_WAITABLES:
            handle = getattr(waitable, name, None)
            if handle is not None:
                yield from getattr(handle, "parts", [handle])
