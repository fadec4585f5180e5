"""What gives way today, each with the item of the trust issue that will mend it.

It shrinks to nothing: the test fails when an entry no longer shows in the slice.
A key is ``family/attack: what was wrong``, or a pattern of such.
"""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase

KNOWN: dict[str, str] = {}


def item_of(key: str) -> str:
    """Return the item that will mend what a key stands for; "" if nobody knows of it."""
    return next((item for known, item in KNOWN.items() if fnmatchcase(key, known)), "")


def mended(keys: Iterable[str]) -> list[str]:
    """Return the entries that none of ``keys`` has to do with."""
    seen = list(keys)
    return sorted(known for known in KNOWN if not any(fnmatchcase(k, known) for k in seen))
