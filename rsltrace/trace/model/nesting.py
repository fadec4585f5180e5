"""How deep brackets are nested in a text: YAML parsers take time with the square of it."""

from __future__ import annotations

import re

NESTING_MAX = 100
_BRACKETS = re.compile(r"[][{}]")


def nested_too_deep(text: str) -> int:
    """Return where brackets are nested more than ``NESTING_MAX`` deep, -1 if nowhere."""
    depth = 0
    for found in _BRACKETS.finditer(text):
        depth = depth + 1 if found[0] in "[{" else max(depth - 1, 0)
        if depth > NESTING_MAX:
            return found.start()
    return -1
