"""What endpoints send through: the trace's channels, links with a model, and who listens in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.faults import TopicFaults
from rsltrace.simulation.middleware.interface import MessageType
from rsltrace.simulation.middleware.links import Network

Watcher = Callable[[Any, bytes], None]
"""Is called with the publisher and the canonical bytes of each message on a topic."""

MessageFilter = Callable[[Any, bytes], bytes | None]
"""Is called with the publisher and the canonical bytes of a message that is about to be published,
and returns those that are published in their place; None: the message is not published."""


class TopicObservers:
    """Who sees every message of a topic: ``filter`` decides what is published, ``watchers`` are
    told what was."""

    def __init__(self) -> None:
        self.filter: MessageFilter | None = None
        self.watchers: list[Watcher] = []


class Transport:
    """How what is sent gets to others. ``network`` is None in a run without models of links;
    ``faults`` are those of single messages, by topic."""

    def __init__(self, dispatcher: Dispatcher) -> None:
        self.dispatcher = dispatcher
        self.network: Network | None = None
        self.faults: dict[str, TopicFaults] = {}
        self.observers: dict[str, TopicObservers] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def channel(
        self, topic: str, type: MessageType, qos_yaml: str = "", *, with_hash: bool = False
    ) -> int:
        """Return the trace's channel for a topic, or -1 if its payloads are not kept."""
        recorder = self.dispatcher.recorder
        if recorder is None or not recorder.keep_payload(topic):
            return -1
        channel = self._channels.get((topic, type.name))
        if channel is None:
            text, type_hash = type.describe()
            channel = recorder.writer.add_channel(
                topic,
                type.name,
                text,
                qos_yaml=qos_yaml,
                type_hash=type_hash if with_hash else "",
            )
            self._channels[topic, type.name] = channel
        return channel
