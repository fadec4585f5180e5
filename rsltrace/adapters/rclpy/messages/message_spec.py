"""The fields of a message class, read once from its ``SLOT_TYPES`` into plain values."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from rsltrace.adapters.rclpy.messages.interface_classes import nested_class, type_name
from rsltrace.fast_dataclass import dataclass

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation header of plain little-endian CDR; positions count from after it."""

HEADER_VALUE = int.from_bytes(HEADER, "little")
CHECK_SLOT = "_check_fields"


@dataclass(frozen=True, slots=True)
class PrimitiveType:
    """A value of fixed size. ``code`` is its letter in `struct`, ``size`` its bytes and alignment.

    ``typecode`` is its letter in `array.array`, which rclpy uses for sequences of numbers; empty
    for ``boolean``, ``octet`` and ``char``, for which rclpy uses lists.
    """

    name: str
    size: int
    code: str
    typecode: str

    @property
    def dtype(self) -> np.dtype[Any]:
        """The numpy type of a fixed-size array of these (numbers only)."""
        # Not by typecode: numpy.dtype("q") is not the object that numpy.int64 arrays have.
        kind = "f" if self.typecode in "fd" else "i" if self.typecode.islower() else "u"
        return np.dtype(f"{kind}{self.size}")


@dataclass(frozen=True, slots=True)
class StringType:
    """A string, or wstring if ``wide``; rclpy does not enforce its ``bound``."""

    wide: bool
    bound: int | None


@dataclass(frozen=True, slots=True)
class ArrayType:
    """Exactly ``length`` items."""

    item: ItemType
    length: int


@dataclass(frozen=True, slots=True)
class SequenceType:
    """Any number of items, or at most ``bound``."""

    item: ItemType
    bound: int | None


@dataclass(frozen=True, slots=True)
class FieldSpec:
    """A field of a message; ``slot`` is the attribute behind its property."""

    name: str
    slot: str
    type: FieldType


@dataclass(frozen=True, slots=True)
class MessageSpec:
    """A message class. ``python_name`` is ``module.Class``, by which rclpy recognises instances.

    ``check_fields`` is the default of the ``_check_fields`` slot; None if there is no such slot.
    """

    type_name: str
    python_name: str
    cls: type
    fields: tuple[FieldSpec, ...]
    check_fields: bool | None


ItemType: TypeAlias = PrimitiveType | StringType | MessageSpec
FieldType: TypeAlias = PrimitiveType | StringType | MessageSpec | ArrayType | SequenceType

PRIMITIVES = {
    primitive.name: primitive
    for primitive in (
        PrimitiveType("boolean", 1, "?", ""),
        PrimitiveType("octet", 1, "c", ""),
        PrimitiveType("char", 1, "c", ""),
        PrimitiveType("int8", 1, "b", "b"),
        PrimitiveType("uint8", 1, "B", "B"),
        PrimitiveType("int16", 2, "h", "h"),
        PrimitiveType("uint16", 2, "H", "H"),
        PrimitiveType("int32", 4, "i", "i"),
        PrimitiveType("uint32", 4, "I", "I"),
        PrimitiveType("int64", 8, "q", "q"),
        PrimitiveType("uint64", 8, "Q", "Q"),
        PrimitiveType("float", 4, "f", "f"),
        PrimitiveType("double", 8, "d", "d"),
    )
}


@cache
def message_spec(cls: type) -> MessageSpec:
    """Describe a message class.

    Raises TypeError if rosidl did not generate the class or rclpy cannot convert a field
    (``wchar``, ``long double``), SetupError if the package of a nested message is missing.
    """
    name = type_name(cls)
    slot_types = getattr(cls, "SLOT_TYPES", None)
    names = getattr(cls, "_fields_and_field_types", None)
    if slot_types is None or names is None:
        raise TypeError(f"{name} is not a message: it has no fields")
    fields = []
    for field_name, slot_type in zip(names, slot_types, strict=True):
        try:
            fields.append(FieldSpec(field_name, f"_{field_name}", _field_type(slot_type)))
        except TypeError as error:
            raise TypeError(f"{name}: field {field_name!r}: {error}") from None
    return MessageSpec(
        type_name=name,
        python_name=f"{cls.__module__}.{cls.__qualname__}",
        cls=cls,
        fields=tuple(fields),
        check_fields=_default_check(cls),
    )


def _default_check(cls: type) -> bool | None:
    if not hasattr(cls, CHECK_SLOT):
        return None
    # The default depends on the environment at import.
    return bool(getattr(cls(), CHECK_SLOT))


def _field_type(slot_type: Any) -> FieldType:
    from rosidl_parser import definition as idl

    if isinstance(slot_type, idl.Array):
        return ArrayType(_item(slot_type.value_type), slot_type.size)
    if isinstance(slot_type, idl.BoundedSequence):
        return SequenceType(_item(slot_type.value_type), slot_type.maximum_size)
    if isinstance(slot_type, idl.UnboundedSequence):
        return SequenceType(_item(slot_type.value_type), None)
    return _item(slot_type)


def _item(slot_type: Any) -> ItemType:
    from rosidl_parser import definition as idl

    if isinstance(slot_type, idl.BasicType) and slot_type.typename in PRIMITIVES:
        return PRIMITIVES[slot_type.typename]
    if isinstance(slot_type, idl.AbstractGenericString):
        bound = slot_type.maximum_size if slot_type.has_maximum_size() else None
        return StringType(isinstance(slot_type, idl.AbstractWString), bound)
    if isinstance(slot_type, idl.NamespacedType):
        return message_spec(nested_class(list(slot_type.namespaces), slot_type.name))
    raise TypeError(f"type {getattr(slot_type, 'typename', slot_type)!s} is not supported by rclpy")


# Padding. CDR aligns each primitive to its size. The position after a string or sequence is known
# only at run time, but often enough of it is known in advance (a multiple of 4, say) to lay out the
# rest.


class KnownOffset(NamedTuple):
    """What is known about a position: it is ``rest`` modulo ``modulus`` (1, 2, 4 or 8)."""

    modulus: int
    rest: int

    def moved(self, size: int) -> KnownOffset:
        return KnownOffset(self.modulus, (self.rest + size) % self.modulus)

    def moved_by_multiple(self, unit: int) -> KnownOffset:
        return self.reduced(min(self.modulus, unit))

    def aligned(self, size: int) -> KnownOffset:
        if self.modulus < size:
            return KnownOffset(size, 0)
        return self.moved(-self.rest % size)

    def reduced(self, modulus: int) -> KnownOffset:
        return KnownOffset(modulus, self.rest % modulus)

    def joined(self, other: KnownOffset) -> KnownOffset:
        """What is known of a position that is one of two."""
        modulus = min(self.modulus, other.modulus)
        while (self.rest - other.rest) % modulus:
            modulus //= 2
        return KnownOffset(modulus, self.rest % modulus)


START = KnownOffset(8, 0)


class FixedValue(NamedTuple):
    """A value in a run of fixed-size values: its `struct` letters, bytes and alignment."""

    code: str
    size: int
    alignment: int


def lay_out(parts: list[FixedValue], rest: int) -> tuple[str, int]:
    """Return the `struct` format (without byte order) and bytes of a run at ``rest`` modulo 8."""
    codes, position = [], rest
    for part in parts:
        gap = -position % part.alignment
        if gap:
            codes.append(f"{gap}x")
        codes.append(part.code)
        position += gap + part.size
    return "".join(codes), position - rest


HEADER_PART = FixedValue("I", 4, 1)
HEADER_PLACE = START.moved(-4)
"""The encapsulation header as the first part of a run that begins with it."""


def fixed_parts(type_: FieldType) -> list[FixedValue] | None:
    """Return a type as one run; None if its size varies or it holds an array of messages."""
    if isinstance(type_, PrimitiveType):
        return [FixedValue(type_.code, type_.size, type_.size)]
    if isinstance(type_, ArrayType) and isinstance(type_.item, PrimitiveType):
        size = type_.item.size * type_.length
        return [FixedValue(f"{size}s", size, type_.item.size)]
    if not isinstance(type_, MessageSpec):
        return None
    if not type_.fields:
        return [FixedValue("x", 1, 1)]
    parts: list[FixedValue] = []
    for field in type_.fields:
        inner = fixed_parts(field.type)
        if inner is None:
            return None
        parts += inner
    return parts


def fixed_size(spec: MessageSpec) -> int | None:
    """Return the size of a message with its header; None if it varies."""
    parts = fixed_parts(spec)
    return None if parts is None else lay_out([HEADER_PART, *parts], HEADER_PLACE.rest)[1]


def after(type_: FieldType, place: KnownOffset) -> KnownOffset:
    """Return where a value ends that begins at ``place``."""
    if isinstance(type_, PrimitiveType):
        return place.aligned(type_.size).moved(type_.size)
    if isinstance(type_, StringType):
        return place.aligned(4).moved(4).moved_by_multiple(4 if type_.wide else 1)
    if isinstance(type_, MessageSpec):
        if not type_.fields:
            return place.moved(1)
        for field in type_.fields:
            place = after(field.type, place)
        return place
    if isinstance(type_, ArrayType):
        if isinstance(type_.item, PrimitiveType):
            size = type_.item.size
            return place.aligned(size).moved(size * type_.length)
        return steady(type_.item, after(type_.item, place))
    return after_items(type_.item, place.aligned(4).moved(4))


def after_items(item: FieldType, place: KnownOffset) -> KnownOffset:
    """Return where any number of items end that begin at ``place``."""
    if isinstance(item, PrimitiveType):
        return place.joined(place.aligned(item.size).moved_by_multiple(item.size))
    return steady(item, place)


def steady(item: FieldType, place: KnownOffset) -> KnownOffset:
    """Return what is known at every turn of a loop over items that begins at ``place``."""
    while True:
        joined = place.joined(after(item, place))
        if joined == place:
            return place
        place = joined


def first_alignment(type_: FieldType) -> int:
    if isinstance(type_, PrimitiveType):
        return type_.size
    if isinstance(type_, MessageSpec):
        return first_alignment(type_.fields[0].type) if type_.fields else 1
    if isinstance(type_, ArrayType):
        return first_alignment(type_.item)
    return 4


def least_size(type_: FieldType) -> int:
    """Return the smallest size of a value, at least 1: it limits the number of items."""
    if isinstance(type_, PrimitiveType):
        return type_.size
    if isinstance(type_, MessageSpec):
        return sum(least_size(field.type) for field in type_.fields) or 1
    if isinstance(type_, ArrayType):
        return type_.length * least_size(type_.item)
    return 4
