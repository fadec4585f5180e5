"""Messages to bytes and back: canonical CDR, one pair of generated functions per message class.

rclpy's own serializer leaves alignment padding uninitialised, so that equal messages give unequal
bytes. What is hashed, recorded and compared must be a function of the message alone: these codecs
give byte for byte what rclpy gives, with zeros for padding and nothing after the last field. They
are also several times as fast, which matters because a simulation does little else.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property
from typing import Any

from rsltrace.adapters.rclpy.wire.decoder_source import make_deserializer
from rsltrace.adapters.rclpy.wire.encoder_source import make_serializer
from rsltrace.adapters.rclpy.wire.message_spec import (
    HEADER_PART,
    HEADER_PLACE,
    HEADER_VALUE,
    Message,
    fixed_parts,
    lay_out,
    message_spec,
)
from rsltrace.adapters.rclpy.wire.source_text import packer


class Codec:
    """How messages of one class are written and read. ``type_name`` is ``std_msgs/msg/UInt64``.

    Each function is generated when it is first asked for (most nodes never use most of their
    parameter services); whoever calls one often should keep it.
    """

    def __init__(self, spec: Message) -> None:
        self._spec = spec
        self.type_name: str = spec.type_name

    @cached_property
    def serialize(self) -> Callable[[Any], bytes]:
        """From a message to its canonical CDR bytes, 4-byte header included.

        It raises TypeError or ValueError naming the field when one holds what rclpy cannot
        serialize either.
        """
        return make_serializer(self._spec)

    @cached_property
    def deserialize(self) -> Callable[[bytes], Any]:
        """From CDR bytes (or any bytes-like object) to a new message that shares no memory with it.

        It raises ValueError naming the type and the offset when the bytes are not a whole message
        of this type in plain CDR, of either byte order. As in rclpy, what is not UTF-8 in strings
        is replaced, and the bounds of bounded types are not checked.
        """
        return make_deserializer(self._spec)

    @cached_property
    def canonical(self) -> Callable[[bytes], bytes]:
        """From CDR bytes to those of ``serialize(deserialize(raw))``: the same message,
        little-endian, with zeros for padding. It raises what those do.
        """
        return _make_canonical(self._spec, self)


@cache
def codec_for(message_class: type) -> Codec:
    """Return the codec of a message class, or of a part of a service or action (made once).

    Raises TypeError if rosidl did not generate the class or it holds a type that rclpy cannot
    convert, and SetupError if the package of a nested message is missing.
    """
    return Codec(message_spec(message_class))


def _make_canonical(spec: Message, codec: Codec) -> Callable[[bytes], bytes]:
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
