"""What Python's own modules remember for a whole process: forgotten for the time of a run.

``tempfile`` finds its folder once and has one sequence of names, ``platform`` asks the machine
once. A second run in the same process would get other names and miss what the first was told of; so
each run begins as in a process of its own, each node has names of its own and is told itself what
it asks, and afterwards everything is as it was.
"""

from __future__ import annotations

import platform
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from rsltrace.guard.guard import engage, engaged
from rsltrace.guard.redirect import replace_attribute

_tempfile: Any = tempfile
_platform: Any = platform
_ASKED_ONCE: dict[str, tuple[str, Callable[[], object]]] = {
    "uname": ("_uname_cache", lambda: None),
    "platform": ("_platform_cache", dict),
    "freedesktop_os_release": ("_os_release_cache", lambda: None),
}
"""Functions of ``platform``, where each keeps its answer, and what is there before the first."""


class _Names:
    """Stands in for ``tempfile``'s sequence of random names: each node has its own."""

    def __init__(self, real: Any) -> None:
        self._real = real

    def __iter__(self) -> _Names:
        return self

    def __next__(self) -> str:
        guard = engaged()
        if guard is None:
            if self._real is None:
                self._real = _tempfile._RandomNameSequence()
            return str(next(self._real))
        names = guard.streams.file_names
        stream = guard.stream(sys._getframe(1))
        if stream not in names:
            names[stream] = _tempfile._RandomNameSequence()
        return str(next(names[stream]))


def _unseen(real: Callable[..., str]) -> Callable[..., str]:
    """Where files go is asked by one node for all: neither its chance nor its finding."""

    def default_folder(*arguments: Any) -> str:
        with engage(None):
            return real(*arguments)

    return default_folder


def _asking(real: Any, cache: str, empty: Callable[[], object]) -> Any:
    """Ask the machine again each time: whoever asked before may have been a library."""

    def ask(*arguments: Any, **options: Any) -> Any:
        setattr(_platform, cache, empty())
        return real(*arguments, **options)

    return ask


@contextmanager
def fresh_module_caches() -> Iterator[None]:
    """Let nothing be remembered from before, and put it back afterwards."""
    with ExitStack() as stack:
        for name, (cache, empty) in _ASKED_ONCE.items():
            if hasattr(platform, cache):
                replace_attribute(stack, platform, cache, empty())
                replace_attribute(
                    stack, platform, name, _asking(getattr(platform, name), cache, empty)
                )
        find = _tempfile._get_default_tempdir
        chosen = tempfile.tempdir
        if chosen is not None and chosen == find():
            chosen = None  # nobody has chosen it
        replace_attribute(stack, tempfile, "tempdir", chosen)
        replace_attribute(stack, tempfile, "_get_default_tempdir", _unseen(find))
        replace_attribute(stack, tempfile, "_name_sequence", _Names(_tempfile._name_sequence))
        yield
