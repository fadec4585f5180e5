"""Generated Python source: constants, indented blocks, and updates of the position.

Both code generators keep the position in the message in a variable ``p``. Most updates of it turn
out to be useless, as no later line reads it; they are removed at the end.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import field
from functools import cache
from typing import Any

from rsltrace.fast_dataclass import dataclass


class Unusual(Exception):
    """Raised and caught in generated code: use the careful function."""


@dataclass(slots=True)
class _Line:
    """A line of source, and whether it ``reads`` and ``writes`` ``p``."""

    text: str
    reads: bool = False
    writes: bool = False


@dataclass(slots=True)
class _Block:
    """A loop: its header and body."""

    header: str
    body: list[_Line | _Block] = field(default_factory=list)


class FunctionSource:
    """The body of one function."""

    def __init__(self, constants: dict[str, Any]) -> None:
        self._constants = dict(constants)
        self._names: dict[Any, str] = {}
        self._body: list[_Line | _Block] = []
        self._variables = 0

    # -- writing ------------------------------------------------------------------------------

    def line(self, text: str) -> None:
        """Add a line that does not use ``p``."""
        self._body.append(_Line(text))

    def use(self, text: str) -> None:
        """Add a line that reads ``p``."""
        self._body.append(_Line(text, reads=True))

    def shift(self, text: str) -> None:
        """Add a line that computes ``p`` from its old value."""
        self._body.append(_Line(text, reads=True, writes=True))

    def assign(self, text: str) -> None:
        """Add a line that sets ``p`` whatever it was."""
        self._body.append(_Line(text, writes=True))

    @contextmanager
    def block(self, header: str) -> Iterator[None]:
        """Put the lines added within the ``with`` block into a loop."""
        outer, block = self._body, _Block(header)
        outer.append(block)
        self._body = block.body
        yield
        self._body = outer

    def variable(self, prefix: str) -> str:
        """Return a name that no other line uses."""
        self._variables += 1
        return f"{prefix}{self._variables}"

    def constant(self, value: Any) -> str:
        """Return a name for a hashable value."""
        if value not in self._names:
            stem = getattr(value, "__name__", type(value).__name__).strip("_<>")
            self._names[value] = f"{stem}_{len(self._names)}"
            self._constants[self._names[value]] = value
        return self._names[value]

    # -- finishing ----------------------------------------------------------------------------

    def compile(
        self, name: str, argument: str, careful: Callable[[Any], Any], title: str
    ) -> Callable[[Any], Any]:
        """Return the function ``name(argument)``; it calls ``careful`` if anything raises."""
        body, _ = _without_idle_updates(self._body, False)
        lines = [f"def {name}({argument}):", "    try:", *_indented(body or [_Line("pass")], 2)]
        # Not called in the handler: its error would have ours as its context.
        lines += ["    except Exception:", "        pass", f"    return careful({argument})"]
        text = "\n".join(lines) + "\n"
        namespace = self._constants | {"careful": careful, "Unusual": Unusual}
        exec(compile(text, f"<{name} {title}>", "exec"), namespace)
        function: Callable[[Any], Any] = namespace[name]
        function.__doc__ = text  # so that help() shows what was generated
        return function


@cache
def packer(codes: str) -> struct.Struct:
    """Return the little-endian Struct of these letters; equal layouts share one."""
    return struct.Struct("<" + codes)


def _without_idle_updates(
    body: list[_Line | _Block], needed: bool
) -> tuple[list[_Line | _Block], bool]:
    """Return the body without useless updates of ``p``, and whether it needs ``p``. ``needed``:
    the code after the body needs it."""
    kept: list[_Line | _Block] = []
    for item in reversed(body):
        if isinstance(item, _Block):
            # The next turn of the loop may read what this one leaves in p.
            inner, begins = _without_idle_updates(item.body, needed)
            if begins and not needed:
                inner, begins = _without_idle_updates(item.body, True)
            kept.append(_Block(item.header, inner))
            needed = needed or begins
        elif not item.writes or needed:
            kept.append(item)
            needed = item.reads or (needed and not item.writes)
    kept.reverse()
    return kept, needed


def _indented(body: list[_Line | _Block], depth: int) -> Iterator[str]:
    for item in body:
        if isinstance(item, _Block):
            yield "    " * depth + item.header
            yield from _indented(item.body or [_Line("pass")], depth + 1)
        else:
            yield "    " * depth + item.text
