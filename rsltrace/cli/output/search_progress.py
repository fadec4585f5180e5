"""Progress on a terminal, and signals that end a run."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]
import os
import signal
import sys
import time
from _thread import start_new_thread
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from rsltrace.trace.model.texts import format_seconds, printable

if TYPE_CHECKING:
    from rsltrace.search.explore.search import Explorer, SearchBudget
    from rsltrace.simulation.loop.stop import Stop


@contextmanager
def interruptible() -> Iterator[Callable[[Callable[[Stop], None]], None]]:
    """End the run cleanly at the first SIGINT, SIGTERM or SIGHUP; a second one interrupts the
    callback that is stuck, a third one ends the process, whatever that callback does."""
    from rsltrace.guard.redirect import copy_of
    from rsltrace.simulation.loop.stop import Stop

    ends: list[Callable[[Stop], None]] = []
    old: dict[int, Any] = {}
    process = os.getpid()
    set_handler = copy_of(_signal.signal)  # not that of nodes, in whose code a signal may come

    def handle(number: int, frame: object) -> None:
        if os.getpid() != process:  # a node's fork, which has no run to end
            signal.signal(number, old[number])
            os.kill(os.getpid(), number)
            return
        if not ends:
            # By the kernel: Python runs no handler while it unwinds a very deep recursion.
            for caught in old:
                set_handler(caught, _DEFAULT)
            raise KeyboardInterrupt(128 + number)
        ends[-1](Stop(_ENDS[number], 128 + number))
        ends.clear()  # not before: any of these calls may be one too many in a recursion
        # Not through sys.stderr: the signal may have come in the middle of a write to it.
        with suppress(OSError):
            what = f"{_ENDS[number]}, closing the trace (repeat to force, twice to kill)"
            os.write(2, f"\nrsltrace: {what}\n".encode())

    for caught in _ENDS:
        if caught != _HANG_UP or signal.getsignal(caught) != signal.SIG_IGN:  # nohup
            old[caught] = signal.signal(caught, handle)
    try:
        with _killed_by_third():
            yield ends.append
    finally:
        for caught_before, handler in old.items():
            signal.signal(caught_before, handler)


@contextmanager
def _killed_by_third() -> Iterator[None]:
    """End the process at the third signal. A thread counts them, because a recursion at its limit
    leaves no room for a handler, and may swallow what that raises."""
    from rsltrace.forking import end_process
    from rsltrace.guard.redirect import copy_of
    from rsltrace.trace.mcap.descriptor import PrivateDescriptor

    reading, writing = map(PrivateDescriptor, os.pipe())
    os.set_blocking(writing.number, False)
    wake_up = copy_of(_signal.set_wakeup_fd)  # not that of nodes
    read = copy_of(os.read)

    def count() -> None:
        came = 0
        with suppress(OSError):  # a node has closed it
            while data := read(reading.number, 1):
                came += data[0] in _ENDS
                if came == _KILLED_BY:
                    end_process(128 + data[0])
        reading.close()

    before = wake_up(writing.number, warn_on_full_buffer=False)
    _after_fork.append(lambda: wake_up(-1))  # else this process counts its child's signals
    start_new_thread(count, ())
    try:
        yield
    finally:
        wake_up(before)
        _after_fork.clear()
        writing.close()


_after_fork: list[Callable[[], object]] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=lambda: [each() for each in _after_fork])
_KILLED_BY = 3
_DEFAULT = int(signal.SIG_DFL)
_HANG_UP = getattr(signal, "SIGHUP", None)  # which Windows has not
_ENDS = {int(signal.SIGINT): "interrupted", int(signal.SIGTERM): "terminated"}
if _HANG_UP is not None:
    _ENDS[int(_HANG_UP)] = "hung up"


@contextmanager
def progress(
    *, quiet: bool, what: str = "recording", time: str = "simulated"
) -> Iterator[Callable[[int, int | None, int], None] | None]:
    """Show a progress bar on a terminal, nothing elsewhere."""
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn(what),
        BarColumn(),
        TextColumn(f"{{task.fields[sim]}} s {time}, {{task.fields[events]}} events"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None, sim="0", events=0)
        first: list[int] = []

        def update(now_ns: int, end_ns: int | None, events: int) -> None:
            if not first:
                first.append(now_ns)
            bar.update(
                task,
                total=None if end_ns is None else end_ns - first[0],
                completed=now_ns - first[0],
                sim=format_seconds(now_ns)[:-6],
                events=events,
            )

        yield update


@contextmanager
def working(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on a terminal; yield a function of the work done and the total."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(printable(what), total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


_LOOK_EVERY_S = 0.2


@contextmanager
def search_line(search: Explorer, budget: SearchBudget) -> Iterator[Callable[[], None]]:
    """Show the progress of a search on a terminal; yield a function that updates it."""
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


def line_of(search: Explorer, budget: SearchBudget, now_s: float) -> str:
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
