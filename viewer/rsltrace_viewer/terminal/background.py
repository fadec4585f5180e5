"""Long walks through a trace that never hold up the screen.

A walk is an iterator. It gets a moment right away, which is enough for most; what takes longer
goes on in a thread, and a newer walk of the same group ends it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import perf_counter
from typing import Any, TypeVar

from textual.app import App
from textual.worker import get_current_worker

from rsltrace.errors import RsltraceError

T = TypeVar("T")
_AT_ONCE_S = 0.02
_REPORT_S = 0.08


def walk(
    app: App[Any],
    group: str,
    steps: Iterator[T],
    arrive: Callable[[T | None, bool], None],
    *,
    at_once_s: float = _AT_ONCE_S,
) -> None:
    """Run ``steps`` to their end and call ``arrive(last, done)`` now and then, and when done.

    ``arrive`` runs on the app's thread. If there was no step at all it gets None.
    """
    app.workers.cancel_group(app, group)
    last: T | None = None
    started = perf_counter()
    while perf_counter() - started < at_once_s:
        try:
            last = next(steps)
        except StopIteration:
            arrive(last, True)
            return
    if last is not None:
        arrive(last, False)

    def rest() -> None:
        worker = get_current_worker()
        latest = last
        reported = perf_counter()
        try:
            for item in steps:
                if worker.is_cancelled:
                    return
                latest = item
                if perf_counter() - reported > _REPORT_S:
                    app.call_from_thread(_unless_cancelled, worker, arrive, latest, False)
                    reported = perf_counter()
            if not worker.is_cancelled:
                app.call_from_thread(_unless_cancelled, worker, arrive, latest, True)
        except RsltraceError as error:
            if not worker.is_cancelled:
                app.call_from_thread(app.notify, str(error), severity="error")

    app.run_worker(rest, group=group, thread=True, exclusive=True, exit_on_error=False)


def _unless_cancelled(worker: Any, arrive: Callable[..., None], item: object, done: bool) -> None:
    if not worker.is_cancelled:
        arrive(item, done)
