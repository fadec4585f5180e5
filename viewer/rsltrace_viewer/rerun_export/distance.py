"""How far two runs are apart: for each set of curves that differs, the distance over time.

    divergence/distance/TOPIC/FIELD    |a-b|, of the last values of both at that moment

What is a curve in one run only, or has another number of values there, differs without a distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace_viewer.rerun_export.columns import EVENT, SIM_TIME, Clock, lists, make_chunk
from rsltrace_viewer.rerun_export.messages.chunks import Points
from rsltrace_viewer.rerun_export.paths import join
from rsltrace_viewer.rerun_export.run import Shown

Key: TypeAlias = tuple[str, str]
"""Topic, and where in its messages the curves are."""

_Ints: TypeAlias = npt.NDArray[np.int64]
_Floats: TypeAlias = npt.NDArray[np.float64]


@dataclass(slots=True)
class Distances:
    """Which curves of two runs are equal; for those that are not, the path of their distance."""

    equal: set[Key] = field(default_factory=set)
    paths: dict[Key, str] = field(default_factory=dict)


def curve_keys(run: Shown) -> dict[Key, str]:
    """Return the paths of a run's curves, by what is the same in another run."""
    keys: dict[Key, str] = {}
    for path in run.seen.curves:
        topic = run.seen.topic_of.get(path, "")
        keys[topic, path[len(run.paths.topic(topic)) :].strip("/") if topic else path] = path
    return keys


def distance_chunks(shown: Sequence[Shown], clock: Clock, found: Distances) -> Iterator[Chunk]:
    """Yield the distances between two runs, and note in ``found`` what there is."""
    ours, theirs = (curve_keys(run) for run in shown)
    for key in ours.keys() & theirs.keys():
        a = _joined(shown[0].seen.points.get(ours[key], []))
        b = _joined(shown[1].seen.points.get(theirs[key], []))
        if a is None or b is None or a[2].shape[1] != b[2].shape[1]:
            continue
        if np.array_equal(a[0], b[0]) and np.array_equal(a[2], b[2], equal_nan=True):
            found.equal.add(key)
            continue
        stamps, events, apart = _distance(a, b)
        if not len(stamps):
            continue
        path = found.paths[key] = join("divergence", "distance", *key)
        times = ((SIM_TIME, clock.array(stamps)), (EVENT, pa.array(events)))
        column = lists(np.ones(len(apart), dtype=np.int64), pa.array(apart))
        yield from make_chunk(path, times, ((rr.Scalars.descriptor_scalars(), column),))
        name = pa.array([[f"|a-b| {key[0]} {key[1]}".strip()]])
        yield from make_chunk(path, (), ((rr.SeriesLines.descriptor_names(), name),))


def _joined(points: list[Points]) -> tuple[_Ints, _Ints, _Floats] | None:
    """Return stamps and events, shape (n,), and values, shape (n, k), in order of time; None if
    there are none, or not as many in each message."""
    rows = [np.asarray(part.value_lengths()) for _, _, part in points]
    counts = np.concatenate(rows) if rows else np.zeros(0)
    if not len(counts) or not counts[0] or (counts != counts[0]).any():
        return None
    stamps, events = (np.concatenate([each[i] for each in points]) for i in (0, 1))
    flat = np.concatenate([part.flatten().to_numpy(zero_copy_only=False) for *_, part in points])
    order = np.argsort(stamps, kind="stable")
    values = flat.astype(np.float64).reshape(len(stamps), -1)
    return stamps[order], events[order], values[order]


def _distance(
    a: tuple[_Ints, _Ints, _Floats], b: tuple[_Ints, _Ints, _Floats]
) -> tuple[_Ints, _Ints, _Floats]:
    """Return stamps, events and distances wherever one of the runs has a new value."""
    stamps = np.union1d(a[0], b[0])
    stamps = stamps[stamps >= max(a[0][0], b[0][0])]
    last_a, last_b = (np.searchsorted(each[0], stamps, "right") - 1 for each in (a, b))
    events = np.where(a[0][last_a] == stamps, a[1][last_a], b[1][last_b])
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.sqrt(np.sum((a[2][last_a] - b[2][last_b]) ** 2, axis=1))
    return stamps, events, apart
