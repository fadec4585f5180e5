"""Directory listings in the order of their names: a file system gives them in any order."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from rsltrace.guard.frames import caller
from rsltrace.guard.guard import engaged
from rsltrace.guard.process_ids import meant_path
from rsltrace.guard.redirect import redirect
from rsltrace.model.finding import Mode, Source


class SortedScan:
    """What ``os.scandir`` returns, in the order of names."""

    def __init__(self, entries: Any) -> None:
        with entries:
            self._entries = iter(sorted(entries, key=lambda entry: os.fsencode(entry.name)))

    def __iter__(self) -> SortedScan:
        return self

    def __next__(self) -> Any:
        return next(self._entries)

    def __enter__(self) -> SortedScan:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Give nothing more."""
        self._entries = iter(())


def _listing(name: str, arrange: Callable[[Any], Any], real: Callable[..., Any]) -> Any:
    call = f"os.{name}()"

    def listed(*arguments: Any, **options: Any) -> Any:
        value = real(*map(meant_path, arguments), **options)
        guard = engaged()
        if guard is None:
            return value
        frame = caller()
        mode = guard.mode(Source.DIRECTORY, frame)
        if mode is Mode.VIRTUAL:
            guard.count(Source.DIRECTORY, call, frame)
            return arrange(value)
        if mode is not Mode.ALLOW:
            shown = repr(value[:10]) if isinstance(value, list) else ""
            guard.watched(Source.DIRECTORY, call, shown, frame)
        return value

    return listed


@contextmanager
def sorted_listings() -> Iterator[None]:
    """Sort what ``os.listdir`` and ``os.scandir`` give, and so glob, pathlib and ``os.walk``."""
    with ExitStack() as stack:
        for name, arrange in (
            ("listdir", lambda value: sorted(value, key=os.fsencode)),
            ("scandir", SortedScan),
        ):
            redirect(stack, getattr(os, name), partial(_listing, name, arrange))
        yield
