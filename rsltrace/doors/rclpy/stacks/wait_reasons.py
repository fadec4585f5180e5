"""Who waits for what, in words: for the message when nothing can happen any more."""

from __future__ import annotations

from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core


def who_waits(core: Core) -> list[str]:
    """Say of every suspended coroutine and blocked call what it waits for."""
    runs = [run.waits_for() for run in core.suspended if not run.task.cancelled()]
    runs += [blocked.waits_for() for blocked in core.blocked if not blocked.is_patient()]
    return runs + [f"(before: {note})" for note in core.notes] if runs else []


def awaited(core: Core, future: object) -> str:
    """Say what would complete a future: the service it is a request to, if it is one."""
    if future is None:
        return "something that is not an rclpy Future"
    for client in core.graph.all_clients():
        if future in getattr(client.wrapper, "_pending_requests", {}).values():
            if client.queue:
                return (
                    f"the response of {client.service}, which has arrived, but its client "
                    "shares a mutually exclusive callback group with this callback, which "
                    "keeps the group busy; give the client a callback group of its own"
                )
            servers = len(core.graph.services(client.service))
            return f"the response of {client.service} ({servers} servers)"
    for action in (action for node in core.graph.nodes for action in node.actions):
        what: str = action.waits_for(future)
        if what:
            return what
    return "a Future that nobody completes"


def called_service(core: Core, frame: FrameType | None) -> str:
    """Say which service a stack waits for in ``Client.call``; empty if it is not there."""
    from rclpy.client import Client

    while frame is not None:
        if frame.f_code is Client.call.__code__:
            service = frame.f_locals["self"].handle.service
            servers = len(core.graph.services(service))
            return f"the response to a service call, of {service} ({servers} servers)"
        frame = frame.f_back
    return ""
