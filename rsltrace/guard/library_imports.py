"""What an installed package does while it is imported is no part of the run.

It may find a cache that the run before had to build: with a thread for a warning, a program that is
asked, a file that is waited for. So its clocks and numbers are its own, and it waits in real time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_LOOK_NS = 1_000


class LibraryImport:
    """One import of a package, with all that it imports itself.

    ``passed_ns`` is how much time it has seen pass; ``at_end`` is called when it is over.
    """

    def __init__(self) -> None:
        self.passed_ns = 0
        self.at_end: list[Callable[[], None]] = []

    def look(self) -> int:
        """Let the time pass that looking at a clock takes; return all that has passed."""
        self.passed_ns += _LOOK_NS
        return self.passed_ns


_present: ContextVar[LibraryImport | None] = ContextVar("library import", default=None)
"""Each call stack of user code (a greenlet) has its own."""

present_import = _present.get
"""Return the import of an installed package that the caller is part of, or None."""


@contextmanager
def importing(*, library: bool) -> Iterator[None]:
    """Import a module of a library, or one of user code that may be imported by a library."""
    outer = _present.get()
    if library and outer is not None:
        yield
        return
    inner = LibraryImport() if library else None
    before = _present.set(inner)
    try:
        yield
    finally:
        _present.reset(before)
        for call in inner.at_end if inner is not None else ():
            call()


__all__ = ["LibraryImport", "importing", "present_import"]
