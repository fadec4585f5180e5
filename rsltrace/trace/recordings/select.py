"""Which topics of a bag play: shell globs over their names."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from fnmatch import fnmatchcase

from rsltrace.errors import BagError


def select_topics(
    names: Sequence[str], topics: Sequence[str], exclude: Sequence[str], bag: str
) -> set[str]:
    """Return the names that match one of ``topics`` (none given: all) and none of ``exclude``.

    ``*`` matches ``/`` too. Raises ``BagError`` listing the topics there are when a glob of
    ``topics`` matches nothing, or nothing is left.
    """
    there_are = f"the bag has {', '.join(sorted(set(names))) or 'no topics'}"
    for glob in unmatched(topics, names):
        close = difflib.get_close_matches(glob, names, n=1)
        hint = f"did you mean {close[0]!r}?" if close else there_are
        raise BagError(f"{bag}: no topic matches {glob!r}: {hint}", glob=glob)
    selected = {
        name
        for name in names
        if (not topics or any(fnmatchcase(name, glob) for glob in topics))
        and not any(fnmatchcase(name, glob) for glob in exclude)
    }
    if not selected:
        raise BagError(f"{bag}: every topic is excluded: {there_are}")
    return selected


def unmatched(globs: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the globs that match none of the names."""
    return tuple(g for g in globs if not any(fnmatchcase(name, g) for name in names))
