"""What is ready to run of a node that an executor of the user's own runs.

The loop runs the nodes of a job itself. A node that user code has given to an executor of its own
(``rclpy.spin`` in a main, ``MultiThreadedExecutor``) runs only while that executor spins: the loop
hands what is ready over to the node's mailbox, and the executor takes it from there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import FrameType
from typing import Any, Protocol

from rsltrace.simulation.loop.loop import Dispatchable, EventLoop
from rsltrace.simulation.middleware.graph import Graph

# What somebody waits for, in words: for the message when nothing can happen any more.


def servers_text(servers: int) -> str:
    """Return ``1 server``, ``0 servers``."""
    return f"{servers} server{'' if servers == 1 else 's'}"


def describe_awaited(graph: Graph, future: object) -> str:
    """Say what would complete a future: the service it is a request to, if it is one."""
    if future is None:
        return "something that is not an rclpy Future"
    for client in graph.all_clients():
        wrapper = getattr(client, "wrapper", None)
        if future in getattr(wrapper, "_pending_requests", {}).values():
            if client.queue:
                return (
                    f"the response of {client.service}, which has arrived, but its client "
                    "shares a mutually exclusive callback group with this callback, which "
                    "keeps the group busy; give the client a callback group of its own"
                )
            servers = servers_text(len(graph.services(client.service)))
            return f"the response of {client.service} ({servers})"
    actions: list[Any] = [action for node in graph.nodes for action in node.actions]
    for action in actions:
        what: str = action.waits_for(future)
        if what:
            return what
    return "a Future that nobody completes"


def describe_service_call(graph: Graph, frame: FrameType | None) -> str:
    """Say which service a stack waits for in ``Client.call``; empty if it is not there."""
    from rclpy.client import Client

    while frame is not None:
        if frame.f_code is Client.call.__code__:
            service = frame.f_locals["self"].handle.service
            servers = servers_text(len(graph.services(service)))
            return f"the response to a service call, of {service} ({servers})"
        frame = frame.f_back
    return ""


class CallbackRunner(Protocol):
    """A stack that spins."""

    def runs(self, mailbox: Mailbox, item: Dispatchable) -> bool:
        """Run what is ready at once, if that is possible."""


class SpinningExecutor(Protocol):
    """The executor that empties a mailbox while it spins."""

    executor: Any

    @property
    def standby(self) -> CallbackRunner | None:
        """The stack that spins, if it can be given what is ready."""

    def wake(self) -> None:
        """Look again: something has come."""


class Mailbox:
    """What is ready and has not run yet, each with its place in the order of all arrivals."""

    def __init__(self, loop: EventLoop) -> None:
        self._next_place = loop.next_place
        self.driver: SpinningExecutor | None = None
        """The executor that has the node now."""
        self.closed = False
        """Whether the process the node lived in has ended: nothing of it runs any more."""
        self.entries: deque[tuple[int, Dispatchable]] = deque()
        self.raised: BaseException | None = None
        """What has come out of the callback that the executor runs, which raises it."""
        self.admitted: Dispatchable | None = None
        """What was taken out and runs now."""

    def keeps(self, item: Dispatchable, leave: Callable[[], None] | None = None) -> bool:
        """Keep what the loop dispatches, or have the executor run it at once; False if that has
        taken it out and runs it now. ``leave`` is called if it is kept."""
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
        """Run what was taken out, on the stack of whoever calls this."""
        self.admitted = item
        item.dispatch()
        self.admitted = None

    def close(self) -> None:
        """Run nothing any more."""
        self.closed = True
        self.driver = None
        self.entries.clear()


def mailbox_of(handle: Any) -> Mailbox | None:
    """Return the mailbox that an event's handle is run from, None if the loop itself runs it."""
    mailbox: Mailbox | None = getattr(handle, "mailbox", None)
    if mailbox is None and getattr(handle, "node", None) is not None:
        mailbox = getattr(handle.node, "mailbox", None)
    return mailbox
