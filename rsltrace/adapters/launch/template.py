"""Text with ``$(…)`` in it, taken apart: the grammar of substitutions in ROS's launch files."""

from __future__ import annotations

import re
from dataclasses import dataclass

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_DEPTH_MAX = 50


@dataclass(frozen=True, slots=True)
class Call:
    """One substitution: ``$(env HOME)`` has the name ``env`` and one argument."""

    name: str
    arguments: tuple[Template, ...]
    written: str


Template = tuple["str | Call", ...]
"""The pieces of a text, in order."""


def parse_template(text: str) -> Template:
    """Take a text apart. ``\\`` before a character takes its meaning away.

    :raises ValueError: if a substitution is not written properly.
    """
    return _Parser(text).template()


class _Parser:
    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._depth = 0

    def template(self, end: str = "") -> Template:
        """Read up to the character ``end`` (a quote, which is skipped), or all there is."""
        parts: list[str | Call] = []
        plain = ""
        text = self._text
        while self._at < len(text):
            char = text[self._at]
            if end and char == end:
                break
            if char == "\\" and self._at + 1 < len(text):
                plain += text[self._at + 1]
                self._at += 2
            elif text.startswith("$(", self._at):
                if plain:
                    parts.append(plain)
                    plain = ""
                parts.append(self._call())
            else:
                plain += char
                self._at += 1
        if end:
            if self._at >= len(text):
                raise ValueError(f"a quote {end} is not closed in {text!r}")
            self._at += 1
        if plain:
            parts.append(plain)
        return tuple(parts)

    def _call(self) -> Call:
        start = self._at
        self._depth += 1
        if self._depth > _DEPTH_MAX:
            raise ValueError(f"substitutions are nested more than {_DEPTH_MAX} deep")
        self._at += 2
        name = _NAME.match(self._text, self._at)
        if name is None:
            raise ValueError(
                f"'$(' begins a substitution, such as $(var name), in {self._text!r}; write \\$( "
                "for plain text"
            )
        self._at = name.end()
        arguments = []
        while True:
            self._skip_blanks()
            if self._at >= len(self._text):
                raise ValueError(f"{self._text[start:]!r} has no closing parenthesis")
            if self._text[self._at] == ")":
                break
            arguments.append(self._argument())
        self._at += 1
        self._depth -= 1
        return Call(name.group(), tuple(arguments), self._text[start : self._at])

    def _argument(self) -> Template:
        text = self._text
        if text[self._at] in "'\"":
            self._at += 1
            return self.template(text[self._at - 1])
        parts: list[str | Call] = []
        while self._at < len(text) and text[self._at] not in " \t\r\n)":
            if text.startswith("$(", self._at):
                parts.append(self._call())
                continue
            if text[self._at] == "\\" and self._at + 1 < len(text):
                self._at += 1
            parts.append(text[self._at])
            self._at += 1
        return tuple(_joined(parts))

    def _skip_blanks(self) -> None:
        while self._at < len(self._text) and self._text[self._at] in " \t\r\n":
            self._at += 1


def _joined(parts: list[str | Call]) -> list[str | Call]:
    joined: list[str | Call] = []
    for part in parts:
        if isinstance(part, str) and joined and isinstance(joined[-1], str):
            joined[-1] += part
        else:
            joined.append(part)
    return joined
