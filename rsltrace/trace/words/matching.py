"""Names and levels as people type them, in filters and in breakpoints."""

from __future__ import annotations

from fnmatch import fnmatchcase

LOG_LEVELS = {"debug": 10, "info": 20, "warn": 30, "warning": 30, "error": 40, "fatal": 50}


def is_named(pattern: str, name: str) -> bool:
    """Whether a name is meant: a glob matches it whole, ``/x`` is it, ``x`` is contained in it."""
    if any(c in pattern for c in "*?["):
        return fnmatchcase(name, pattern)
    if pattern.startswith("/"):
        return name == pattern
    return pattern.casefold() in name.casefold()
