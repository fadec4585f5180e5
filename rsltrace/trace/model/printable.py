"""Names and texts out of a file that anybody may have made, safe to show on a terminal."""

from __future__ import annotations

import re

_NOT_PRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\u202a-\u202e\u2066-\u2069]"
)
_NOT_IN_LINES = re.compile(f"(?![\n\t]){_NOT_PRINTABLE.pattern}")
_SHORT = {"\n": r"\n", "\r": r"\r", "\t": r"\t"}


def printable(text: str) -> str:
    """Return ``text`` on one line, with what could steer a terminal written as escapes.

    Names and log texts come from the trace, and a trace may come from anybody.
    """
    return _NOT_PRINTABLE.sub(_escaped, text)


def printable_lines(text: str) -> str:
    """Return ``text`` with what could steer a terminal written as escapes; its lines stay."""
    return _NOT_IN_LINES.sub(_escaped, text)


def shortened(text: str, width: int) -> str:
    """Return ``text`` with at most ``width`` characters; an ellipsis stands for what is cut."""
    return text if len(text) <= width else text[: max(width - 1, 0)] + "…"


def told_apart(a: str, b: str, width: int = 40, before: int = 20) -> tuple[str, str]:
    """Return two different texts, printable, in at most ``width`` characters in which they differ:
    of long ones from ``before`` characters before the place where they do."""
    a, b = printable(a), printable(b)
    at = next(
        (i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b))
    )
    if max(len(a), len(b)) > width and at > width - before:
        a, b = (f"…{text[at - before :]}" for text in (a, b))
    return shortened(a, width), shortened(b, width)


def _escaped(match: re.Match[str]) -> str:
    character = match.group()
    return _SHORT.get(character) or character.encode("unicode_escape").decode("ascii")
