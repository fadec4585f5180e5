"""How far a search is: a line on a terminal, nothing in pipes and files."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rsltrace.search.explore.search import Budget, Search

_LOOK_EVERY_S = 0.2


@contextmanager
def search_line(search: Search, budget: Budget) -> Iterator[Callable[[], None]]:
    """Show a line about a search on a terminal; give a function that brings it up to date."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(stderr=True), transient=True, auto_refresh=False) as live:
        last = [0.0]

        def update() -> None:
            now = time.monotonic()
            if now - last[0] >= _LOOK_EVERY_S:
                last[0] = now
                live.update(line_of(search, budget, now), refresh=True)

        yield update


def line_of(search: Search, budget: Budget, now_s: float) -> str:
    """Return the line: runs, rate, digests, failures, time left."""
    tally = search.tally
    passed_s = max(now_s - search.began_s, 1e-9)
    rate = search.runs_here / passed_s
    parts = [
        f"{tally.runs} runs",
        f"{rate:.1f}/s",
        f"{len(tally.digests)} digests",
        f"{sum(tally.failures.values())} failed ({len(tally.failures)} causes)",
    ]
    if budget.seconds is not None:
        left_s = max(budget.seconds - passed_s, 0)
    elif budget.trials is not None and rate > 0:
        left_s = max(budget.trials - tally.runs, 0) / rate
    else:
        return ", ".join(parts)
    minutes, seconds = divmod(int(left_s), 60)
    return ", ".join([*parts, f"{minutes}:{seconds:02} left"])
