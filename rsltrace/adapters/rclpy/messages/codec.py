"""Messages to bytes and back: canonical CDR, with generated functions per message class.

rclpy's serializer leaves padding uninitialised, so that equal messages give different bytes. These
codecs give the bytes of rclpy, with zeros as padding and nothing after the last field, so that
bytes can be hashed and compared. They are also several times as fast, and more so where a compiler
has built ``rsltrace/_cdr.c``: then the generated functions are for what is unusual.
"""

from __future__ import annotations

import array
import sys
from collections.abc import Callable
from functools import cache, cached_property
from typing import Any

from rsltrace.adapters.rclpy.messages.decoder_source import make_deserializer
from rsltrace.adapters.rclpy.messages.encoder_source import make_serializer
from rsltrace.adapters.rclpy.messages.message_spec import (
    HEADER_PART,
    HEADER_PLACE,
    HEADER_VALUE,
    ArrayType,
    FieldSpec,
    MessageSpec,
    PrimitiveType,
    SequenceType,
    StringType,
    fixed_parts,
    lay_out,
    least_size,
    message_spec,
)
from rsltrace.adapters.rclpy.messages.source_text import packer
from rsltrace.compiled import core


class Codec:
    """Serializes and deserializes messages of one class (``type_name``: ``std_msgs/msg/UInt64``).

    Each function is made on first use, as most nodes never use their parameter services. Keep a
    function that you call often.
    """

    def __init__(self, spec: MessageSpec) -> None:
        self._spec = spec
        self.type_name: str = spec.type_name

    @cached_property
    def serialize(self) -> Callable[[Any], bytes]:
        """From a message to its canonical CDR bytes with the 4-byte header.

        Raises TypeError or ValueError naming the field, if rclpy cannot serialize it either.
        """
        plan = compiled_plan(self._spec.cls)
        return _serializer(self._spec.cls) if plan is None else plan.serialize

    @cached_property
    def deserialize(self) -> Callable[[bytes], Any]:
        """From CDR bytes of either byte order to a new message that shares no memory with them.

        Raises ValueError naming type and offset, if they are no whole message of this type in plain
        CDR. As in rclpy, invalid UTF-8 is replaced, and bounds are not checked.
        """
        plan = compiled_plan(self._spec.cls)
        return _deserializer(self._spec.cls) if plan is None else plan.deserialize

    @cached_property
    def canonical(self) -> Callable[[bytes], bytes]:
        """Shortcut for ``serialize(deserialize(raw))``: the canonical bytes of a message."""
        return _make_canonical(self._spec, self)


@cache
def codec_for(message_class: type) -> Codec:
    """Return the codec of a message class, or of a part of a service or action.

    Raises TypeError if rosidl did not generate the class or rclpy cannot convert a field,
    SetupError if the package of a nested message is missing.
    """
    return Codec(message_spec(message_class))


@cache
def compiled_plan(message_class: type) -> Any:
    """Return the compiled module's plan of a class; None if it has none for one of the fields."""
    if core is None:
        return None
    spec = message_spec(message_class)
    fields = [_planned(field) for field in spec.fields]
    if None in fields:
        return None
    try:
        return core.MessagePlan(
            spec.cls,
            spec.check_fields,
            tuple(fields),
            lambda message: _serializer(message_class)(message),  # made when it is needed
            lambda raw: _deserializer(message_class)(raw),
        )
    except (AttributeError, ImportError, TypeError):
        return None  # the class has not the slots of rosidl's, or the arrays are not numpy's


@cache
def _serializer(message_class: type) -> Callable[[Any], bytes]:
    return make_serializer(message_spec(message_class))


@cache
def _deserializer(message_class: type) -> Callable[[bytes], Any]:
    return make_deserializer(message_spec(message_class))


_SINGLE, _ARRAY, _SEQUENCE = range(3)
_ANY_NUMBER = min(2**32 - 1, sys.maxsize // 8)


def _planned(field: FieldSpec) -> tuple[Any, ...] | None:
    """Describe a field to the compiled module: as ``Field`` in ``_cdr.c``; None if it cannot be."""
    type_ = field.type
    item = type_.item if isinstance(type_, ArrayType | SequenceType) else type_
    shape, number = _SINGLE, 1
    if isinstance(type_, ArrayType):
        shape, number = _ARRAY, type_.length
    elif isinstance(type_, SequenceType):
        shape, number = _SEQUENCE, _ANY_NUMBER if type_.bound is None else type_.bound
    made_of: Any = None
    if isinstance(item, PrimitiveType):
        code, size = item.code, item.size
        if item.name == "char":
            return None
        if item.typecode:
            made_of = item.dtype if shape == _ARRAY else array.array(item.typecode, [0])
    elif isinstance(item, StringType):
        code, size = "s", 4
        if item.wide:
            return None
    else:
        code, size, made_of = "m", 1, compiled_plan(item.cls)
        if made_of is None:
            return None
    return field.slot, code, size, shape, number, least_size(item), made_of


def _make_canonical(spec: MessageSpec, codec: Codec) -> Callable[[bytes], bytes]:
    def by_message(raw: bytes) -> bytes:
        return codec.serialize(codec.deserialize(raw))

    parts = fixed_parts(spec)
    if parts is None or any(part.code == "c" for part in parts):
        return by_message
    # Values that are all of fixed size need no message in between.
    codes, size = lay_out([HEADER_PART, *parts], HEADER_PLACE.rest)
    sizes = (size, size + 3 & -4)
    pack, unpack_from = packer(codes).pack, packer(codes).unpack_from

    def by_values(raw: bytes) -> bytes:
        if len(raw) in sizes:
            values = unpack_from(raw)
            if values[0] == HEADER_VALUE:
                return pack(*values)
        return by_message(raw)

    return by_values
