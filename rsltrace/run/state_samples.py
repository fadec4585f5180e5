"""Hashes of nodes' states, taken now and then: what differs before it is published.

``rsltrace verify`` has its runs do so. The samples are no part of the digest, which is the same
whether or not anybody looks.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from rsltrace.adapters.rclpy.handles.node_state import NodeState
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder

if TYPE_CHECKING:
    from rsltrace.simulation.middleware.events.dispatcher import Dispatcher


class _Samples:
    """Those of one node."""

    def __init__(self, state: NodeState) -> None:
        self.state = state
        self.events = 0
        self.next = 1
        self.taken: list[tuple[int, dict[str, str]]] = []


class StateSamples(EventObserver):
    """Samples each node's state after its 1st, 2nd, 4th, 8th ... event, and at the end of the run:
    a long run costs little more than a short one."""

    order = ObserverOrder.STATE_SAMPLES

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher
        self._nodes: dict[str, _Samples] = {}

    def after_event(self) -> None:
        """Take a sample if it is time for one of the event's node."""
        node = self._dispatcher.event.node
        if getattr(node, "wrapper", None) is None:  # nobody's, a main's, or in another process
            return
        samples = self._nodes.get(node.key)
        if samples is None:
            samples = _Samples(NodeState(self._dispatcher, node, keeps=False))
            self._nodes[node.key] = samples
        samples.events += 1
        if samples.events == samples.next:
            samples.next *= 2
            self._take(samples)

    def take_last(self) -> None:
        """Take the samples of the end of the run, while the nodes are there."""
        for samples in self._nodes.values():
            self._take(samples)

    def _take(self, samples: _Samples) -> None:
        recorder: Any = self._dispatcher.recorder
        hashes = samples.state.attribute_hashes()
        samples.taken.append(
            (recorder.index - 1, {name: f"{value:x}" for name, value in hashes.items()})
        )

    def as_metadata(self) -> dict[str, str]:
        """Return what a trace keeps (docs/trace-format.md)."""
        taken = {name: samples.taken for name, samples in self._nodes.items()}
        return {"samples": json.dumps(taken, sort_keys=True, separators=(",", ":"))}
