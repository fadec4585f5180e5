"""Hashes of a node's state: its attributes, without those of rclpy."""

from __future__ import annotations

import dis
import json
from collections.abc import Iterator
from functools import lru_cache
from types import CodeType, FunctionType
from typing import Any

from rsltrace.guard.guard import engage
from rsltrace.guard.state.hashing import UNCHANGING, StateHasher
from rsltrace.guard.state.snapshot import Snapshots
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.simulation.middleware.events.observer import EventObserver, ObserverOrder
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.finding import GuardPolicy


class NodeState:
    """Hashes one node's state; with ``keeps``, changes are recorded, too."""

    def __init__(self, dispatcher: Dispatcher, handle: Any, *, keeps: bool) -> None:
        self._dispatcher = dispatcher
        self._handle = handle
        self._hasher = StateHasher()
        self._snapshots = Snapshots() if keeps else None
        self._names: list[str | None] = []
        self._shown: dict[str, tuple[str, bool]] = {}
        self._last: dict[str, tuple[object, int, str]] = {}

    @property
    def left_out(self) -> dict[str, str]:
        """The attributes that cannot be hashed, with their types."""
        return self._hasher.skipped

    def attribute_hashes(self) -> dict[str, int]:
        """Return the hash of each of the node's attributes now."""
        node = self._handle.wrapper
        with engage(None):
            return {} if node is None else self._hashes(self._attributes(node))[0]

    def after_event(self) -> int:
        """Return the hash of the node's state, 0 if there is no node yet."""
        node = self._handle.wrapper
        if node is None:
            return 0
        with engage(None):  # reads by the hash are no findings
            attributes = self._attributes(node)
            hashes, text = self._hashes(attributes)
            recorder = self._dispatcher.recorder
            if self._snapshots is not None and recorder is not None:
                changes = self._snapshots.changes(attributes, hashes)
                if changes:
                    changed = json.dumps(changes, separators=(",", ":"), sort_keys=True)
                    recorder.state(self._handle.entity_id, self._dispatcher.loop.now_ns, changed)
        return hash64(text.encode("utf-8", "surrogatepass")) or 1

    def _hashes(self, attributes: dict[str, Any]) -> tuple[dict[str, int], str]:
        """Return the hashes by attribute, and all of them as one text."""
        last, hashes, parts = self._last, {}, []
        for name, value in attributes.items():
            before = last.get(name)
            if before is not None and before[0] is value:  # an immutable that was not set
                _, digest, part = before
            else:
                digest = self._hasher.digest(value, name)
                part = f"{name}={digest:x};"
                if type(value) in UNCHANGING:
                    last[name] = value, digest, part
            hashes[name] = digest
            parts.append(part)
        return hashes, "".join(parts)

    def _attributes(self, node: Any) -> dict[str, Any]:
        hook = getattr(node, "rsltrace_state", None)
        if callable(hook):
            state = hook()
            return dict(state) if isinstance(state, dict) else {"rsltrace_state()": state}
        own, parameters = vars(node), node._parameters
        names = [*own, None, *parameters]
        if names != self._names:
            rclpys = _attributes_of_rclpy(type(node))  # type: ignore[arg-type]
            self._names = names
            shown = {name: (name, False) for name in own if name not in rclpys}
            shown.update({f"parameter {name}": (name, True) for name in parameters})
            self._shown = dict(sorted(shown.items()))
        return {
            as_shown: parameters[name].value if is_parameter else own[name]
            for as_shown, (name, is_parameter) in self._shown.items()
        }


def own_attributes(node: Any) -> dict[str, Any]:
    """Return a node's attributes, without those of rclpy, and its parameters."""
    rclpys = _attributes_of_rclpy(type(node))  # type: ignore[arg-type]
    found = {name: value for name, value in vars(node).items() if name not in rclpys}
    found.update({f"parameter {name}": one.value for name, one in node._parameters.items()})
    return dict(sorted(found.items()))


class NodeStates:
    """The states of a run's nodes; ``policy`` is for nodes without their own."""

    def __init__(self) -> None:
        self.policy = GuardPolicy()
        self.by_node: dict[str, NodeState] = {}

    def add(self, handle: Any) -> NodeState | None:
        """Return the state of a new node, or None if it is not hashed."""
        wanted = (handle.policy or self.policy).state
        if not wanted:
            return None
        state = NodeState(handle.dispatcher, handle, keeps=wanted == "record")
        self.by_node[handle.key] = state
        return state


@lru_cache(maxsize=256)
def _attributes_of_rclpy(kind: type) -> frozenset[str]:
    """Return the attributes that rclpy's own classes set on a node of this class."""
    return frozenset(
        name
        for cls in kind.__mro__
        if cls.__module__.partition(".")[0] in ("rclpy", "rsltrace")
        for function in vars(cls).values()
        if isinstance(function, FunctionType)
        for name in _stored_on_self(function.__code__)
    )


def _stored_on_self(code: CodeType) -> Iterator[str]:
    before = None
    for instruction in dis.get_instructions(code):
        # Python 3.13 loads the value and self in one instruction.
        if (
            instruction.opname == "STORE_ATTR"
            and before is not None
            and before.opname.startswith("LOAD_FAST")
            and "self" in str(before.argval)
        ):
            yield str(instruction.argval)
        before = instruction


# Samples of states, taken now and then by the runs of ``rsltrace verify``: what differs before it
# is published. They are no part of the digest, which is the same whether or not anybody looks.


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
