"""Counting events in columns without aliasing: a sensor with a steady rate gets a steady bar.

Whole events, counted in columns of 50 ms, make a sensor of 30 Hz look like 1, 2, 1, 2, 2. So an
event counts for the time from itself to the next one of its entity, and a column gets as much of it
as lies in the column. Where events are more than a few columns apart, each is a mark of its own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_APART = 4
"""Events that are more columns apart than this are drawn one by one."""

_USUAL = 0.9
"""The gap between events that is usual: as long as that part of all gaps at most. Not the median:
many entities run twice in a row."""

_SILENT = 2.0
"""A gap that is longer than so many usual ones is silence, and is shown as that."""

Floats = npt.NDArray[np.float64]


def spread(
    starts: Floats, ends: Floats, counts: Floats, step: int, columns: int, *, exact: bool
) -> Floats:
    """Return how many events of one entity fall into each column, in fractions. Shape (columns,).

    ``counts`` events begin at ``starts`` and last until ``ends`` (ns since the left edge, shapes
    (n,), in order and apart). ``exact``: all of an entry's events are at its start.
    """
    single = (ends - starts > _APART * step) & (exact | (counts == 1))
    single |= ends <= starts
    places = np.floor(starts[single] / step).astype(np.int64)
    inside = (places >= 0) & (places < columns)
    found: Floats = np.bincount(
        places[inside], weights=counts[single][inside], minlength=columns
    ).astype(np.float64)
    starts, ends, counts = starts[~single], ends[~single], counts[~single]
    if len(starts):
        # The number of events up to a time: it rises in each entry and stands still in between.
        times = np.stack((starts, ends), axis=1).ravel()
        total = np.cumsum(counts)
        numbers = np.stack((total - counts, total), axis=1).ravel()
        edges = np.arange(columns + 1, dtype=np.float64) * step
        found += np.diff(np.interp(edges, times, numbers))
    return np.asarray(np.round(found, 6))


def ends_of(starts: Floats, counts: Floats) -> Floats:
    """Return when each entry ends: at the next one, but where the entity then was silent for long
    (or for good) after as long as its events usually take."""
    if not len(starts):
        return starts
    gaps = np.diff(starts) / counts[:-1]
    if not len(gaps):
        return starts
    place = int(_USUAL * (len(gaps) - 1))
    usual = float(np.partition(gaps, place)[place])
    silent = np.append(gaps > _SILENT * usual, True)
    return np.where(silent, starts + counts * usual, np.append(starts[1:], 0.0))
