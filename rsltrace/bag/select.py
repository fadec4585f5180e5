"""Which topics of a bag play: shell globs over their names."""

from __future__ import annotations

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
    for glob in topics:
        if not any(fnmatchcase(name, glob) for name in names):
            raise BagError(f"{bag}: no topic matches {glob!r}: {there_are}")
    selected = {
        name
        for name in names
        if (not topics or any(fnmatchcase(name, glob) for glob in topics))
        and not any(fnmatchcase(name, glob) for glob in exclude)
    }
    if not selected:
        raise BagError(f"{bag}: every topic is excluded: {there_are}")
    return selected
