"""Types by name: all that the middleware knows of what it carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


def _unknown() -> tuple[str, str]:
    return "", ""


@dataclass(frozen=True, slots=True)
class MessageType:
    """The type of a topic, a request or a response: ``std_msgs/msg/UInt64``.

    ``describe`` gives its definition and its type hash (either may be empty), for those who read
    the trace; it is asked when the first message is kept.
    """

    name: str
    describe: Callable[[], tuple[str, str]] = _unknown


@dataclass(frozen=True, slots=True)
class ServiceType:
    """The type of a service, with those of its two messages."""

    name: str
    request: MessageType
    response: MessageType
