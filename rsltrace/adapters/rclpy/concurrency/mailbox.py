"""Mailboxes: the ready callbacks of nodes that an executor of user code runs.

The loop runs the nodes of a job itself. The callbacks of a node that user code gave to an executor
(``rclpy.spin`` in a main, ``MultiThreadedExecutor``) run only while that executor spins: the loop
puts them into the node's mailbox, and the executor takes them out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import FrameType
from typing import Any, Protocol

from rsltrace.adapters.rclpy.concurrency.callback_groups import is_busy
from rsltrace.simulation.loop.loop import Dispatchable, EventLoop
from rsltrace.simulation.middleware.graph import Graph


def servers_text(servers: int) -> str:
    return f"{servers} server{'' if servers == 1 else 's'}"


def _shares(end: str, holder: str) -> str:
    return (
        f"its {end} shares a mutually exclusive callback group with {holder}, which keeps "
        f"the group busy; give the {end} a callback group of its own"
    )


def describe_awaited(graph: Graph, future: object) -> str:
    """Describe what would complete a future, such as the response of a service."""
    if future is None:
        return "something that is not an rclpy Future"
    for client in graph.all_clients():
        wrapper = getattr(client, "wrapper", None)
        if future in getattr(wrapper, "_pending_requests", {}).values():
            if client.queue:
                shares = _shares("client", "this callback")
                return f"the response of {client.service}, which has arrived, but {shares}"
            for server in graph.services(client.service):
                owner = getattr(server, "wrapper", None)
                if server.queue and is_busy(getattr(owner, "callback_group", None), owner):
                    shares = _shares("server", "a callback that has not ended")
                    asked = f"the response of {client.service}, whose request has arrived"
                    return f"{asked}, but {shares}"
            servers = servers_text(len(graph.services(client.service)))
            return f"the response of {client.service} ({servers})"
    actions: list[Any] = [action for node in graph.nodes for action in node.actions]
    for action in actions:
        what: str = action.waits_for(future)
        if what:
            return what
    return "a Future that no callback completes"


def describe_service_call(graph: Graph, frame: FrameType | None) -> str:
    """Describe the service that a stack waits for in ``Client.call``; empty if it does not."""
    from rclpy.client import Client

    while frame is not None:
        if frame.f_code is Client.call.__code__:
            service = frame.f_locals["self"].handle.service
            servers = servers_text(len(graph.services(service)))
            return f"the response to a service call, of {service} ({servers})"
        frame = frame.f_back
    return ""


class CallbackRunner(Protocol):
    """A spinning stack."""

    def runs(self, mailbox: Mailbox, item: Dispatchable) -> bool:
        """Run an item at once, if that is possible."""


class SpinningExecutor(Protocol):
    """The driver of an executor that takes from a mailbox."""

    executor: Any

    @property
    def standby(self) -> CallbackRunner | None:
        """The spinning stack, if it can run an item at once."""

    def wake(self) -> None:
        """Look for items again."""


class Mailbox:
    """Ready items of one node, each with its place in the order of all arrivals."""

    def __init__(self, loop: EventLoop) -> None:
        self._next_place = loop.next_place
        self.driver: SpinningExecutor | None = None
        """The driver of the node's executor."""
        self.closed = False
        """Whether the node's process has ended."""
        self.entries: deque[tuple[int, Dispatchable]] = deque()
        self.raised: BaseException | None = None
        """The exception of a callback, which the executor raises."""
        self.admitted: Dispatchable | None = None
        """The item that was taken out and runs now."""

    def keeps(self, item: Dispatchable, leave: Callable[[], None] | None = None) -> bool:
        """Keep an item that the loop dispatches (and call ``leave``), or run it on a spinning
        stack.

        Returns False if the executor has taken the item, so that it runs now.
        """
        if self.admitted is item:
            self.admitted = None
            return False
        driver = self.driver
        if driver is not None and driver.standby is not None and driver.standby.runs(self, item):
            return True
        if leave is not None:
            leave()
        if not self.closed:
            self.entries.append((self._next_place(), item))
            if driver is not None:
                driver.wake()
        return True

    def run(self, item: Dispatchable) -> None:
        """Run an item that was taken out, on the calling stack."""
        self.admitted = item
        item.dispatch()
        self.admitted = None

    def close(self) -> None:
        self.closed = True
        self.driver = None
        self.entries.clear()


def mailbox_of(handle: Any) -> Mailbox | None:
    """Return the mailbox of a handle, None if the loop itself runs it."""
    mailbox: Mailbox | None = getattr(handle, "mailbox", None)
    if mailbox is None and getattr(handle, "node", None) is not None:
        mailbox = getattr(handle.node, "mailbox", None)
    return mailbox
