"""A series of durations in a few numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Durations = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Figures:
    """Durations in ns: how many, the least, quantiles, the most, their mean and deviation.

    A quantile is one of the durations, the smallest that so many do not exceed.
    """

    count: int
    min_ns: int
    p50_ns: int
    p95_ns: int
    p99_ns: int
    max_ns: int
    mean_ns: float
    sd_ns: float

    @property
    def jitter_ns(self) -> int:
        """The most less the least."""
        return self.max_ns - self.min_ns


def figures(durations: Durations) -> Figures | None:
    """Return the figures of durations, None if there are none."""
    if not len(durations):
        return None
    ordered = np.sort(durations)
    return Figures(
        len(ordered),
        int(ordered[0]),
        quantile(ordered, 50),
        quantile(ordered, 95),
        quantile(ordered, 99),
        int(ordered[-1]),
        float(ordered.mean()),
        float(ordered.std()),
    )


def quantile(ordered: Durations, percent: float) -> int:
    """Return the smallest of some sorted durations that ``percent`` of them do not exceed."""
    rank = math.ceil(round(percent * len(ordered) / 100, 9))
    return int(ordered[min(max(rank, 1), len(ordered)) - 1])
