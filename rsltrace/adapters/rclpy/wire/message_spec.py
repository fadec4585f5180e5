"""What a message class holds, read once from its ``SLOT_TYPES`` into plain values.

rosidl's own description objects are many small classes behind a parser; the code generators want
to ask one thing only: of what is this field made?
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from rsltrace.adapters.rclpy.wire.interface_classes import nested_class, type_name

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation of plain little-endian CDR. Positions (and alignment) count from after it."""

HEADER_VALUE = int.from_bytes(HEADER, "little")
CHECK_SLOT = "_check_fields"


@dataclass(frozen=True, slots=True)
class Primitive:
    """A value of fixed size. ``code`` is its letter in `struct`, ``size`` its bytes and alignment.

    ``typecode`` is its letter in `array.array`, which rclpy uses for sequences of numbers; empty
    for ``boolean``, ``octet`` and ``char``, of which rclpy makes lists.
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
class Text:
    """A string, or wstring if ``wide``. Its ``bound`` in characters is for information: rclpy's
    serializer does not enforce it."""

    wide: bool
    bound: int | None


@dataclass(frozen=True, slots=True)
class Array:
    """Exactly ``length`` items."""

    item: Item
    length: int


@dataclass(frozen=True, slots=True)
class Sequence:
    """Any number of items, or at most ``bound``."""

    item: Item
    bound: int | None


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message; ``slot`` is the attribute behind its property."""

    name: str
    slot: str
    type: FieldType


@dataclass(frozen=True, slots=True)
class Message:
    """A message class. ``python_name`` is ``module.Class``, by which rclpy recognises instances.

    ``check_fields`` is what a default-constructed instance holds in its ``_check_fields`` slot;
    None if the class has no such slot.
    """

    type_name: str
    python_name: str
    cls: type
    fields: tuple[Field, ...]
    check_fields: bool | None


Item: TypeAlias = Primitive | Text | Message
FieldType: TypeAlias = Primitive | Text | Message | Array | Sequence

PRIMITIVES = {
    primitive.name: primitive
    for primitive in (
        Primitive("boolean", 1, "?", ""),
        Primitive("octet", 1, "c", ""),
        Primitive("char", 1, "c", ""),
        Primitive("int8", 1, "b", "b"),
        Primitive("uint8", 1, "B", "B"),
        Primitive("int16", 2, "h", "h"),
        Primitive("uint16", 2, "H", "H"),
        Primitive("int32", 4, "i", "i"),
        Primitive("uint32", 4, "I", "I"),
        Primitive("int64", 8, "q", "q"),
        Primitive("uint64", 8, "Q", "Q"),
        Primitive("float", 4, "f", "f"),
        Primitive("double", 8, "d", "d"),
    )
}


@cache
def message_spec(cls: type) -> Message:
    """Describe a message class.

    Raises TypeError if rosidl did not generate the class, or if a field is of a type that rclpy
    cannot convert either (``wchar``, ``long double``), and SetupError if the package of a nested
    message is missing.
    """
    name = type_name(cls)
    slot_types = getattr(cls, "SLOT_TYPES", None)
    names = getattr(cls, "_fields_and_field_types", None)
    if slot_types is None or names is None:
        raise TypeError(f"{name} is not a message: it has no fields")
    fields = []
    for field_name, slot_type in zip(names, slot_types, strict=True):
        try:
            fields.append(Field(field_name, f"_{field_name}", _field_type(slot_type)))
        except TypeError as error:
            raise TypeError(f"{name}: field {field_name!r}: {error}") from None
    return Message(
        type_name=name,
        python_name=f"{cls.__module__}.{cls.__qualname__}",
        cls=cls,
        fields=tuple(fields),
        check_fields=_default_check(cls),
    )


def _default_check(cls: type) -> bool | None:
    if not hasattr(cls, CHECK_SLOT):
        return None
    # What the generated __init__ would set depends on the environment at import; ask it.
    return bool(getattr(cls(), CHECK_SLOT))


def _field_type(slot_type: Any) -> FieldType:
    from rosidl_parser import definition as idl

    if isinstance(slot_type, idl.Array):
        return Array(_item(slot_type.value_type), slot_type.size)
    if isinstance(slot_type, idl.BoundedSequence):
        return Sequence(_item(slot_type.value_type), slot_type.maximum_size)
    if isinstance(slot_type, idl.UnboundedSequence):
        return Sequence(_item(slot_type.value_type), None)
    return _item(slot_type)


def _item(slot_type: Any) -> Item:
    from rosidl_parser import definition as idl

    if isinstance(slot_type, idl.BasicType) and slot_type.typename in PRIMITIVES:
        return PRIMITIVES[slot_type.typename]
    if isinstance(slot_type, idl.AbstractGenericString):
        bound = slot_type.maximum_size if slot_type.has_maximum_size() else None
        return Text(isinstance(slot_type, idl.AbstractWString), bound)
    if isinstance(slot_type, idl.NamespacedType):
        return message_spec(nested_class(list(slot_type.namespaces), slot_type.name))
    raise TypeError(f"type {getattr(slot_type, 'typename', slot_type)!s} is not supported by rclpy")
