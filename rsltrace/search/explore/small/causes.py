"""Making the failures of a search small: one run of each cause."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rsltrace.errors import ExploreError
from rsltrace.search.explore.small.folder import write_small
from rsltrace.search.explore.small.reduction import Reduction
from rsltrace.search.explore.table import SMALL
from rsltrace.search.explore.trial import JobSource, TrialResult
from rsltrace.search.explore.workers import Worker

_CAUSES_MAX = 10


@dataclass(frozen=True, slots=True)
class SmallRun:
    """A cause of failures made small: its folder, and the one difference that decides (empty if
    there is none). ``trouble`` says why there is no folder."""

    folder: Path
    decides: str = ""
    trouble: str = ""


def make_small(
    source: JobSource,
    first: Mapping[str, TrialResult],
    folder: Path,
    *,
    pins: bool = True,
    timeout_s: float | None = None,
    on_begin: Callable[[str], None] = lambda cause: None,
) -> dict[str, SmallRun]:
    """Reduce the first run of each cause; ``folder`` of the search gets a folder for each.

    ``on_begin`` is told which cause is next.
    """
    found = {}
    by_number = sorted(first.items(), key=lambda item: item[1].trial.number)
    for key, result in by_number[:_CAUSES_MAX]:
        on_begin(key)
        place = folder / SMALL / f"{result.trial.number:06d}"
        try:
            with (
                tempfile.TemporaryDirectory(dir=folder) as scratch,
                Worker(source, pins=pins) as worker,
            ):
                reduced = Reduction(
                    source, result, worker, Path(scratch), timeout_s=timeout_s
                ).reduce()
                decides = write_small(source, reduced, place, timeout_s=timeout_s)
            found[key] = SmallRun(place, decides)
        except ExploreError as error:
            found[key] = SmallRun(place, trouble=str(error))
        except OSError as error:
            found[key] = SmallRun(place, trouble=f"{error.filename}: {error.strerror}")
    return found
