"""Where CDR puts padding, worked out while generating code so that it costs little at run time.

CDR aligns each primitive to its size, counted from the end of the 4-byte encapsulation header. What
follows a string or a sequence stands at a position known only at run time; but often enough of it
is known (a multiple of 4, say) to lay the rest out beforehand.
"""

from __future__ import annotations

from typing import NamedTuple

from rsltrace.adapters.rclpy.wire.message_spec import Array, FieldType, Message, Primitive, Text


class Place(NamedTuple):
    """All that is known about a position: it is ``rest`` modulo ``modulus`` (1, 2, 4 or 8)."""

    modulus: int
    rest: int

    def moved(self, size: int) -> Place:
        """The place ``size`` bytes further on."""
        return Place(self.modulus, (self.rest + size) % self.modulus)

    def moved_by_multiple(self, unit: int) -> Place:
        """The place some multiple of ``unit`` bytes further on."""
        return self.reduced(min(self.modulus, unit))

    def aligned(self, size: int) -> Place:
        """The place after padding to a multiple of ``size`` bytes."""
        if self.modulus < size:
            return Place(size, 0)
        return self.moved(-self.rest % size)

    def reduced(self, modulus: int) -> Place:
        """The same place, knowing less."""
        return Place(modulus, self.rest % modulus)

    def joined(self, other: Place) -> Place:
        """What is known when it is either of two places."""
        modulus = min(self.modulus, other.modulus)
        while (self.rest - other.rest) % modulus:
            modulus //= 2
        return Place(modulus, self.rest % modulus)


START = Place(8, 0)


class Part(NamedTuple):
    """One item of a run of fixed-size values: its `struct` letters, bytes and alignment."""

    code: str
    size: int
    alignment: int


def lay_out(parts: list[Part], rest: int) -> tuple[str, int]:
    """Return (`struct` format without byte order, bytes) of a run at ``rest`` modulo 8."""
    codes, position = [], rest
    for part in parts:
        gap = -position % part.alignment
        if gap:
            codes.append(f"{gap}x")
        codes.append(part.code)
        position += gap + part.size
    return "".join(codes), position - rest


HEADER_PART = Part("I", 4, 1)
HEADER_PLACE = START.moved(-4)
"""The encapsulation header as the first part of a run that begins with it."""


def fixed_parts(type_: FieldType) -> list[Part] | None:
    """Return a value as one run; None if its size varies or it holds an array of messages."""
    if isinstance(type_, Primitive):
        return [Part(type_.code, type_.size, type_.size)]
    if isinstance(type_, Array) and isinstance(type_.item, Primitive):
        size = type_.item.size * type_.length
        return [Part(f"{size}s", size, type_.item.size)]
    if not isinstance(type_, Message):
        return None
    if not type_.fields:
        return [Part("x", 1, 1)]
    parts: list[Part] = []
    for field in type_.fields:
        inner = fixed_parts(field.type)
        if inner is None:
            return None
        parts += inner
    return parts


def fixed_size(spec: Message) -> int | None:
    """Return the bytes of every message of this class with its header; None if not one run."""
    parts = fixed_parts(spec)
    return None if parts is None else lay_out([HEADER_PART, *parts], HEADER_PLACE.rest)[1]


def after(type_: FieldType, place: Place) -> Place:
    """Return where a value of this type ends that begins at ``place``."""
    if isinstance(type_, Primitive):
        return place.aligned(type_.size).moved(type_.size)
    if isinstance(type_, Text):
        return place.aligned(4).moved(4).moved_by_multiple(4 if type_.wide else 1)
    if isinstance(type_, Message):
        if not type_.fields:
            return place.moved(1)
        for field in type_.fields:
            place = after(field.type, place)
        return place
    if isinstance(type_, Array):
        if isinstance(type_.item, Primitive):
            size = type_.item.size
            return place.aligned(size).moved(size * type_.length)
        return steady(type_.item, after(type_.item, place))
    return after_items(type_.item, place.aligned(4).moved(4))


def after_items(item: FieldType, place: Place) -> Place:
    """Return where any number of items end that begin at ``place``; none need no alignment."""
    if isinstance(item, Primitive):
        return place.joined(place.aligned(item.size).moved_by_multiple(item.size))
    return steady(item, place)


def steady(item: FieldType, place: Place) -> Place:
    """Return what is known at the start of every turn of a loop over items that begins here."""
    while True:
        joined = place.joined(after(item, place))
        if joined == place:
            return place
        place = joined


def first_alignment(type_: FieldType) -> int:
    """Return the alignment of the first byte of a value."""
    if isinstance(type_, Primitive):
        return type_.size
    if isinstance(type_, Message):
        return first_alignment(type_.fields[0].type) if type_.fields else 1
    if isinstance(type_, Array):
        return first_alignment(type_.item)
    return 4


def least_size(type_: FieldType) -> int:
    """Return the least number of bytes a value takes; never 0, so it limits how many can be."""
    if isinstance(type_, Primitive):
        return type_.size
    if isinstance(type_, Message):
        return sum(least_size(field.type) for field in type_.fields) or 1
    if isinstance(type_, Array):
        return type_.length * least_size(type_.item)
    return 4
