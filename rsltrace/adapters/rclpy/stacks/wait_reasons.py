"""What somebody waits for, in words: for the message when nothing can happen any more."""

from __future__ import annotations

from types import FrameType
from typing import Any

from rsltrace.simulation.middleware.graph import Graph


def servers_text(servers: int) -> str:
    """Return ``1 server``, ``0 servers``."""
    return f"{servers} server{'' if servers == 1 else 's'}"


def awaited(graph: Graph, future: object) -> str:
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


def called_service(graph: Graph, frame: FrameType | None) -> str:
    """Say which service a stack waits for in ``Client.call``; empty if it is not there."""
    from rclpy.client import Client

    while frame is not None:
        if frame.f_code is Client.call.__code__:
            service = frame.f_locals["self"].handle.service
            servers = servers_text(len(graph.services(service)))
            return f"the response to a service call, of {service} ({servers})"
        frame = frame.f_back
    return ""
