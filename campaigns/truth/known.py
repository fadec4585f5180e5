"""What a diff says that is not so, as far as it is known; it shrinks to nothing.

A key is ``class: what is wrong``, or a pattern of such; the value says whether seed 0 shows it.
"""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase

ALWAYS = "always"
SOMETIMES = "sometimes"

KNOWN: dict[str, str] = {}


def item_of(key: str) -> str:
    """Return whether something that is wrong is known, "" if nobody knows of it."""
    return next((why for known, why in KNOWN.items() if fnmatchcase(key, known)), "")


def mended(keys: Iterable[str], names: Iterable[str]) -> list[str]:
    """Return the entries for classes that were tried of which none of ``keys`` is."""
    seen, tried = list(keys), set(names)
    return sorted(
        known
        for known, why in KNOWN.items()
        if why == ALWAYS
        and known.rpartition(": ")[0] in tried
        and not any(fnmatchcase(key, known) for key in seen)
    )
