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
    """Those of one node: ``event`` is the last one before each."""

    def __init__(self, state: NodeState) -> None:
        self.state = state
        self.events = 0
        self.taken: list[tuple[int, dict[str, str]]] = []

    def take(self, event: int) -> None:
        """Take one, if the node is still there and its state can be read: code of the user's may
        do that (``rsltrace_state``)."""
        try:
            hashes = self.state.attribute_hashes()
        except Exception:
            hashes = {}
        if hashes:
            self.taken.append((event, {name: f"{value:x}" for name, value in hashes.items()}))


class StateSamples(EventObserver):
    """Samples each node's state after its 1st, 2nd, 4th, 8th ... event, and at the end of the run:
    a long run costs little more than a short one."""

    order = ObserverOrder.STATE_SAMPLES

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher
        self._nodes: dict[Any, _Samples] = {}

    def after_event(self) -> None:
        """Take a sample if it is time for one of the event's node."""
        node = self._dispatcher.event.node
        if getattr(node, "wrapper", None) is None:  # nobody's, a main's, or in another process
            return
        samples = self._nodes.get(node)
        if samples is None:
            samples = _Samples(NodeState(self._dispatcher, node, keeps=False))
            self._nodes[node] = samples
        samples.events += 1
        if not samples.events & (samples.events - 1):  # a power of two
            samples.take(self._last_event())

    def take_last(self) -> None:
        """Take the samples of the end of the run, while the nodes are there."""
        for samples in self._nodes.values():
            samples.take(self._last_event())

    def _last_event(self) -> int:
        recorder = self._dispatcher.recorder
        assert recorder is not None, "samples are for a trace"
        return recorder.index - 1

    def as_metadata(self) -> dict[str, str]:
        """Return what a trace keeps (docs/trace-format.md). A node that has started again has the
        samples of all its lives."""
        taken: dict[str, list[tuple[int, dict[str, str]]]] = {}
        for node, samples in self._nodes.items():
            taken.setdefault(node.key, []).extend(samples.taken)
        return {"samples": json.dumps(taken, sort_keys=True, separators=(",", ":"))}
