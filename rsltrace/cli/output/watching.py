"""Watching a run that is being recorded: its progress on a terminal, and an end by a signal."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from rsltrace.trace.model.stamp import format_seconds

if TYPE_CHECKING:
    from rsltrace.simulation.loop.stop import Stop


@contextmanager
def interruptible() -> Iterator[Callable[[Callable[[Stop], None]], None]]:
    """Turn the first SIGINT, SIGTERM or SIGHUP into a proper end of the run; a second one
    interrupts whatever callback is stuck."""
    from rsltrace.simulation.loop.stop import Stop

    ends: list[Callable[[Stop], None]] = []
    old: dict[int, Any] = {}
    process = os.getpid()

    def handle(number: int, frame: object) -> None:
        if os.getpid() != process:  # forked by a node: no run to end, so as if nobody had asked
            signal.signal(number, old[number])
            os.kill(os.getpid(), number)
            return
        if not ends:
            raise KeyboardInterrupt(128 + number)
        end, name = ends.pop(), _ENDS[signal.Signals(number)]
        # Not through sys.stderr: the signal may have come in the middle of a write to it.
        with suppress(OSError):
            os.write(2, f"\nrsltrace: {name}, closing the trace (once more to force)\n".encode())
        end(Stop(name, 128 + number))

    for caught in _ENDS:
        if caught != signal.SIGHUP or signal.getsignal(caught) != signal.SIG_IGN:  # nohup
            old[caught] = signal.signal(caught, handle)
    try:
        yield ends.append
    finally:
        for caught_before, handler in old.items():
            signal.signal(caught_before, handler)


_ENDS = {
    signal.SIGINT: "interrupted",
    signal.SIGTERM: "terminated",
    signal.SIGHUP: "hung up",
}


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
