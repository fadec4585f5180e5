"""Messages to bytes and back: canonical CDR, one pair of generated functions per message class.

rclpy's own serializer leaves alignment padding uninitialised, so that equal messages give unequal
bytes. What is hashed, recorded and compared must be a function of the message alone: these codecs
give byte for byte what rclpy gives, with zeros for padding and nothing after the last field. They
are also several times as fast, which matters because a simulation does little else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from rsltrace.ros.codec_layout import HEADER_PART, HEADER_PLACE, fixed_parts, lay_out
from rsltrace.ros.codec_read import make_deserializer
from rsltrace.ros.codec_source import packer
from rsltrace.ros.codec_spec import HEADER_VALUE, Message, message_spec
from rsltrace.ros.codec_write import make_serializer


@dataclass(frozen=True, slots=True)
class Codec:
    """How messages of one class are written and read.

    ``serialize(message)`` returns CDR bytes with their 4-byte header. It raises TypeError or
    ValueError naming the field when one holds what rclpy cannot serialize either.

    ``deserialize(raw)`` returns a new message that shares no memory with ``raw`` (bytes; any
    bytes-like object works). It raises ValueError naming the type and the offset when ``raw`` is
    not a whole message of this type in plain CDR, of either byte order.

    ``canonical(raw)`` returns ``serialize(deserialize(raw))``: the same message, little-endian,
    with zeros for padding. It raises what those do.
    """

    type_name: str
    serialize: Callable[[Any], bytes]
    deserialize: Callable[[bytes], Any]
    canonical: Callable[[bytes], bytes]


@cache
def codec_for(message_class: type) -> Codec:
    """Return the codec of a message class, or of a part of a service or action (made once).

    Raises TypeError if rosidl did not generate the class or it holds a type that rclpy cannot
    convert, and SetupError if the package of a nested message is missing.
    """
    spec = message_spec(message_class)
    serialize = make_serializer(spec)
    deserialize = make_deserializer(spec)
    return Codec(
        type_name=spec.type_name,
        serialize=serialize,
        deserialize=deserialize,
        canonical=_make_canonical(spec, serialize, deserialize),
    )


def _make_canonical(
    spec: Message, serialize: Callable[[Any], bytes], deserialize: Callable[[bytes], Any]
) -> Callable[[bytes], bytes]:
    def by_message(raw: bytes) -> bytes:
        return serialize(deserialize(raw))

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
