"""Directory listings in the order of their names: a file system gives them in any order."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from rsltrace.guard.frames import caller
from rsltrace.guard.guard import engaged
from rsltrace.guard.process_ids import meant_path
from rsltrace.guard.redirect import redirect
from rsltrace.trace.model.finding import Mode, Source

_NAMES_MAX = 20
"""Names of a listing that the trace keeps."""


class SortedScan:
    """What ``os.scandir`` returns, in the order of names."""

    def __init__(self, entries: list[Any]) -> None:
        self._entries = iter(entries)

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


def _sorted_names(value: list[Any]) -> tuple[list[Any], list[Any]]:
    names = sorted(value, key=os.fsencode)
    return names, names


def _sorted_scan(value: Any) -> tuple[SortedScan, list[Any]]:
    with value:
        entries = sorted(value, key=lambda entry: os.fsencode(entry.name))
    return SortedScan(entries), [entry.name for entry in entries]


def _call(name: str, arguments: tuple[Any, ...]) -> str:
    path = arguments[0] if arguments else "."
    return f"os.{name}({os.fspath(path) if isinstance(path, os.PathLike) else path!r})"


def _told(names: list[Any]) -> str:
    """Return how many names there are, and which: two runs may have found others."""
    texts = [os.fsdecode(name) for name in names]
    if not texts:
        return "no names"
    more = len(texts) - _NAMES_MAX
    if more <= 0:
        return f"{len(texts)} name{'' if len(texts) == 1 else 's'} ({', '.join(texts)})"
    digest = hashlib.sha256("\0".join(texts).encode(errors="surrogateescape")).hexdigest()[:16]
    return f"{len(texts)} names, SHA-256 {digest} ({', '.join(texts[:_NAMES_MAX])}, …)"


def _listing(
    name: str, arrange: Callable[[Any], tuple[Any, list[Any]]], real: Callable[..., Any]
) -> Any:
    call = f"os.{name}()"

    def listed(*arguments: Any, **options: Any) -> Any:
        value = real(*map(meant_path, arguments), **options)
        guard = engaged()
        if guard is None:
            return value
        frame = caller()
        mode = guard.mode(Source.DIRECTORY, frame)
        if mode is Mode.VIRTUAL:
            arranged, names = arrange(value)
            guard.count(Source.DIRECTORY, call, frame)
            guard.answered(Source.DIRECTORY, _call(name, arguments), partial(_told, names), frame)
            return arranged
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
            ("listdir", _sorted_names),
            ("scandir", _sorted_scan),
        ):
            redirect(stack, getattr(os, name), partial(_listing, name, arrange))
        yield
