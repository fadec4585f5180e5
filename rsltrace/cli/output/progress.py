"""How far a command is that takes long: a bar on a terminal, nothing in pipes and files."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rsltrace.trace.model.printable import printable


@contextmanager
def working(what: str) -> Iterator[Callable[[int, int], None]]:
    """Say on a terminal that ``what`` is under way; give a function to tell of done and total.

    As long as that is not told, nobody knows how far it is: the bar moves, and the time goes on.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(printable(what), total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
