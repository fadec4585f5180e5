"""The words of the filter language: cut out of a text, with the place where each stands."""

from __future__ import annotations

import re
from collections.abc import Callable

from rsltrace.fast_dataclass import dataclass

LARGEST = 2**64 - 1
"""The end of a range that has none: stamps, indexes and hashes are unsigned 64-bit."""
_TOKEN = re.compile(r'\s+|(?P<bracket>[()])|(?P<word>(?:"(?:\\.|[^"\\])*"?|[^\s()"])+)')


class QueryError(ValueError):
    """A filter that cannot be understood. ``start`` and ``end`` say which characters of it."""

    def __init__(self, message: str, start: int, end: int) -> None:
        super().__init__(message)
        self.start = start
        self.end = max(end, start + 1)


@dataclass(frozen=True, slots=True)
class Token:
    """A word or a bracket, and at which character of the filter it begins."""

    text: str
    start: int

    @property
    def end(self) -> int:
        return self.start + len(self.text)


def tokens(text: str) -> list[Token]:
    """Cut a filter at its blanks and brackets; what is in quotes stays in one piece."""
    found = []
    position = 0
    while position < len(text):
        matched = _TOKEN.match(text, position)
        assert matched is not None  # one of the three fits any character
        if matched.lastgroup:
            found.append(Token(matched.group(), position))
        position = matched.end()
    return found


def unquoted(token: Token) -> str:
    """Return the text without its quotes. Raises QueryError if one is not closed."""
    text = token.text
    if '"' not in text:
        return text
    if not (text.startswith('"') and text.endswith('"') and len(text) > 1):
        at = token.start + text.index('"')
        raise QueryError("this quote is not closed", at, token.end)
    return re.sub(r"\\(.)", r"\1", text[1:-1])


def alternatives(token: Token) -> list[Token]:
    """Return the alternatives of ``a,b``; a quoted value is one. Raises QueryError."""
    if token.text.startswith('"'):
        return [Token(unquoted(token), token.start)]
    parts = []
    start = token.start
    for part in token.text.split(","):
        if not part:
            raise QueryError("a value is missing here", start, start + 1)
        parts.append(Token(part, start))
        start += len(part) + 1
    return parts


def number_range(token: Token, number: Callable[[str], int], what: str) -> tuple[int, int]:
    """Read ``a..b``, ``a..``, ``..b``, ``>a``, ``<b`` or ``a``; both ends belong to it.

    ``what`` completes "not …" where ``number`` raises ValueError. Raises QueryError.
    """

    def read(text: str, start: int) -> int:
        try:
            return number(text)
        except ValueError as error:
            raise QueryError(f"not {what}: {error}", start, start + max(len(text), 1)) from None

    text = token.text
    if text[0] in "<>":
        skip = 2 if text[1:2] == "=" else 1
        value = read(text[skip:], token.start + skip)
        strict = skip == 1
        return (value + strict, LARGEST) if text[0] == ">" else (0, max(value - strict, 0))
    low, dots, high = text.partition("..")
    first = read(low, token.start) if low else 0
    if not dots:
        return first, first
    last = read(high, token.start + len(low) + 2) if high else LARGEST
    if last < first:
        raise QueryError("the end is before the start", token.start, token.end)
    return first, last
