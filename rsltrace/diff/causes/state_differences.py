"""Which attributes of a node differ after an event, where states were recorded."""

from __future__ import annotations

from typing import Any

import numpy as np

from rsltrace.diff.alignment.rows import ComparedTrace
from rsltrace.diff.facts.evidence import EventSummary, StateDifference
from rsltrace.trace.states import StateValue, state_after

DIFFERENCES_MAX = 20


def state_differences(
    run_a: ComparedTrace, run_b: ComparedTrace, a: EventSummary | None, b: EventSummary | None
) -> tuple[StateDifference, ...]:
    """Return the values in which a node's states differ, by path; none if they are not recorded."""
    if a is None or b is None or a.state_hash == b.state_hash:
        return ()
    states = []
    for run, view in ((run_a, a), (run_b, b)):
        trace = run.trace
        node = _node_of(run, view)
        states.append(state_after(trace, node, view.index) if node else {})
    one, other = states
    found: list[StateDifference] = []
    alone = one.keys() ^ other.keys()
    for path in sorted({*one, *other}, key=lambda path: (path in alone, path)):
        found += _differences(path, one.get(path), other.get(path))
        if len(found) >= DIFFERENCES_MAX:
            break
    return tuple(found[:DIFFERENCES_MAX])


def _node_of(run: ComparedTrace, view: EventSummary) -> int:
    names = (e.id for e in run.trace.entities.values() if e.name == view.entity.node and e.id)
    return next(names, 0)


def _differences(path: str, a: StateValue | None, b: StateValue | None) -> list[StateDifference]:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        if a.shape == b.shape and a.dtype == b.dtype:
            return _elements(path, a, b)
    elif a == b:
        return []
    return [StateDifference(path, _shown(a), _shown(b))]


def _elements(path: str, a: Any, b: Any) -> list[StateDifference]:
    same = (a == b) | ((a != a) & (b != b))
    return [
        StateDifference(
            path + "".join(f"[{number}]" for number in place), repr(x.item()), repr(y.item())
        )
        for place in np.argwhere(~same)[:DIFFERENCES_MAX].tolist()
        for x, y in [(a[tuple(place)], b[tuple(place)])]
    ]


def _shown(leaf: StateValue | None) -> str | None:
    if isinstance(leaf, np.ndarray):
        return f"array of {leaf.dtype}, shape {leaf.shape}"
    return leaf
