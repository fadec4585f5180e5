"""Messages to bytes and back: canonical CDR, with generated functions per message class.

rclpy's serializer leaves padding uninitialised, so that equal messages give different bytes. These
codecs give the bytes of rclpy, with zeros as padding and nothing after the last field, so that
bytes can be hashed and compared. They are also several times as fast.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property
from typing import Any

from rsltrace.adapters.rclpy.messages.decoder_source import make_deserializer
from rsltrace.adapters.rclpy.messages.encoder_source import make_serializer
from rsltrace.adapters.rclpy.messages.message_spec import (
    HEADER_PART,
    HEADER_PLACE,
    HEADER_VALUE,
    MessageSpec,
    fixed_parts,
    lay_out,
    message_spec,
)
from rsltrace.adapters.rclpy.messages.source_text import packer


class Codec:
    """Serializes and deserializes messages of one class (``type_name``: ``std_msgs/msg/UInt64``).

    Each function is generated on first use, as most nodes never use their parameter services. Keep
    a function that you call often.
    """

    def __init__(self, spec: MessageSpec) -> None:
        self._spec = spec
        self.type_name: str = spec.type_name

    @cached_property
    def serialize(self) -> Callable[[Any], bytes]:
        """From a message to its canonical CDR bytes with the 4-byte header.

        Raises TypeError or ValueError naming the field, if rclpy cannot serialize it either.
        """
        return make_serializer(self._spec)

    @cached_property
    def deserialize(self) -> Callable[[bytes], Any]:
        """From CDR bytes of either byte order to a new message that shares no memory with them.

        Raises ValueError naming type and offset, if they are no whole message of this type in plain
        CDR. As in rclpy, invalid UTF-8 is replaced, and bounds are not checked.
        """
        return make_deserializer(self._spec)

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
