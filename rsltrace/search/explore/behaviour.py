"""What a run did, as hashes that other runs of the job can be compared with."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsltrace.trace.chain import hash64
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.reader import Trace

Hashes = npt.NDArray[np.uint64]

_FACTORS = tuple(
    np.uint64(factor)
    for factor in (
        0x9E3779B97F4A7C15,
        0xC2B2AE3D27D4EB4F,
        0x165667B19E3779F9,
        0x27D4EB2F165667C5,
        0x94D049BB133111EB,
    )
)
_SHIFT = np.uint64(29)


def identities(trace: Trace) -> dict[int, str]:
    """Return a name for each entity that it has in other runs, too: node, kind, name, and which
    one of several that are called alike."""
    names: dict[int, str] = {}
    seen: dict[str, int] = {}
    for entity in trace.entities.values():
        name = f"{_node(trace, entity)} {entity.kind.label} {entity.name}"
        seen[name] = seen.get(name, 0) + 1
        names[entity.id] = name if seen[name] == 1 else f"{name} ({seen[name]})"
    return names


def _node(trace: Trace, entity: Entity) -> str:
    return trace.node_of(entity).name if entity.node else ""


def events_of(trace: Trace) -> npt.NDArray[np.void]:
    """Return the events of a run before its nodes were destroyed."""
    pieces = list(trace.events(0, trace.ended_after))
    return np.concatenate(pieces) if pieces else np.empty(0, dtype=[("entity", "<u4")])


def behaviours_of(trace: Trace) -> tuple[int, ...]:
    """Return a hash for each kind of thing that happened: an event with its content and the state
    of its node after it, and two events of a node one after the other."""
    events = events_of(trace)
    if not len(events):
        return ()
    by_id, nodes = _tables(trace)
    entity = events["entity"]
    name = by_id[entity]
    kind = events["kind"].astype(np.uint64)
    done = _mixed(name, kind, events["input_hash"], events["output_hash"], events["state_hash"])
    node = nodes[entity]
    order = np.argsort(node, kind="stable")
    same = node[order][1:] == node[order][:-1]
    first, second = name[order][:-1][same], name[order][1:][same]
    return tuple(np.unique(np.concatenate([done, _mixed(first, second)])).tolist())


def final_state_of(trace: Trace) -> str:
    """Return a hash of how the nodes were at the end: 16 hex digits.

    A node counts with the hash of its state where that is made (``guard: state``), else with all
    of its events in their order: two runs with the same hash have left the same nodes then.
    """
    events = events_of(trace)
    if not len(events):
        return ""
    by_id, nodes = _tables(trace)
    owner = nodes[events["entity"]]
    total, names = 0, identities(trace)
    for node in np.unique(owner).tolist():
        own = events[owner == node]
        last = int(own["state_hash"][-1])
        if last == 0:
            done = _mixed(by_id[own["entity"]], own["input_hash"], own["output_hash"])
            last = hash64(done.tobytes())
        total ^= hash64(f"{names[node]}\0{last:016x}".encode())
    return f"{total:016x}"


def _tables(trace: Trace) -> tuple[Hashes, npt.NDArray[np.int64]]:
    """Return a hash of the name, and the node, of each entity by its id."""
    size = max(trace.entities) + 1
    hashes, nodes = np.zeros(size, dtype=np.uint64), np.zeros(size, dtype=np.int64)
    for number, name in identities(trace).items():
        hashes[number] = hash64(name.encode())
        nodes[number] = trace.entity(number).node
    return hashes, nodes


def _mixed(*columns: npt.NDArray[np.uint64]) -> Hashes:
    """Return one hash for each row."""
    total = np.zeros(len(columns[0]), dtype=np.uint64)
    for column, factor in zip(columns, _FACTORS, strict=False):
        total = (total ^ column) * factor
        total ^= total >> _SHIFT
    return total
