"""How often callbacks run, counted in steps of simulated time.

Counting needs a number per entity and step, whatever the length of the run, so this is gathered
while the events pass and written at the end.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from rsltrace.trace.model.stamp import NS_PER_S

_STEPS, _STEPS_OF_SHORT = 120, 20
"""About so many points per curve: enough to see a rate change, few enough to be one glance. A step
much shorter than a period would alternate between none and one."""
_SHORT_NS = 10 * NS_PER_S

_SHORTEST_NS = 1_000_000


def step_for(duration_ns: int) -> int:
    """Return a round length (1, 2 or 5 times a power of ten, in ns) of which a run has some 120.

    Runs of up to ten seconds have some 20; longer ones get no step below a second.
    """
    if duration_ns <= _SHORT_NS:
        wanted = max(duration_ns // _STEPS_OF_SHORT, _SHORTEST_NS)
    else:
        wanted = max(duration_ns // _STEPS, NS_PER_S)
    step = _SHORTEST_NS
    while True:
        for factor in (1, 2, 5):
            if step * factor >= wanted:
                return step * factor
        step *= 10


class Rates:
    """Counts events per entity and step of simulated time."""

    def __init__(self, start_ns: int, end_ns: int, entities: int) -> None:
        """Prepare for a run from ``start_ns`` to ``end_ns`` and entity ids below ``entities``."""
        self.step_ns = step_for(max(end_ns - start_ns, 1))
        self._start_ns = start_ns
        self._steps = max(end_ns - start_ns, 0) // self.step_ns + 1
        self._entities = entities
        self._counts = np.zeros((entities, self._steps), dtype=np.int64)
        self._last_event = np.zeros(self._steps, dtype=np.int64)

    def add(self, events: npt.NDArray[np.void]) -> None:
        """Count events (EVENT_DTYPE)."""
        known = events[events["entity"] < self._entities]
        stamps = known["stamp"].astype(np.int64)
        steps = np.clip((stamps - self._start_ns) // self.step_ns, 0, self._steps - 1)
        cells = known["entity"].astype(np.int64) * self._steps + steps
        size = self._entities * self._steps
        self._counts += np.bincount(cells, minlength=size).reshape(self._counts.shape)
        np.maximum.at(self._last_event, steps, known["index"].astype(np.int64))

    @property
    def stamps_ns(self) -> npt.NDArray[np.int64]:
        """The ends of the steps: a rate is that of the step which ends there. Shape (steps,)."""
        ends = self._start_ns + self.step_ns * np.arange(1, self._steps + 1, dtype=np.int64)
        return np.asarray(ends)

    @property
    def events(self) -> npt.NDArray[np.int64]:
        """The last event of each step, or the one before for a step without any."""
        return np.maximum.accumulate(self._last_event)

    def of(self, entity_ids: list[int]) -> npt.NDArray[np.float64]:
        """Return events per simulated second of some entities together, shape (steps,)."""
        total = self._counts[entity_ids].sum(axis=0)
        return np.asarray(total * (NS_PER_S / self.step_ns), dtype=np.float64)

    def running(self) -> Iterator[int]:
        """Yield the entities that had an event at all."""
        yield from np.flatnonzero(self._counts.any(axis=1)).tolist()
