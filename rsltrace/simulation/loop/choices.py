"""What a policy has chosen, one byte for each choice it had: enough to choose the same again.

The events of a trace do not say it all. What is told to an executor of the user's own, or wakes
somebody who looks and waits again, has no event, and yet it matters when it was its turn.
"""

from __future__ import annotations

from collections.abc import Iterator

_LARGE = 255
"""Stands for a choice that needs more than one byte, which follows in four."""


class Choices:
    """The choices of a run so far, in order. Where only one could run there was none."""

    def __init__(self) -> None:
        self._data = bytearray()

    def __bool__(self) -> bool:
        return bool(self._data)

    def add(self, index: int) -> None:
        """Remember that the policy chose ``index`` of those that were ready."""
        if index < _LARGE:
            self._data.append(index)
        else:
            self._data.append(_LARGE)
            self._data += index.to_bytes(4, "little")

    def encoded(self) -> bytes:
        """Return the choices as a trace holds them."""
        return bytes(self._data)


def decoded(data: bytes) -> Iterator[int]:
    """Yield the choices that ``Choices.encoded`` wrote."""
    at = 0
    while at < len(data):
        index, at = data[at], at + 1
        if index == _LARGE:
            index, at = int.from_bytes(data[at : at + 4], "little"), at + 4
        yield index
