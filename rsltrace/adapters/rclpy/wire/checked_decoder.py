"""The careful deserializer: either byte order, and errors that name the field and the offset.

The generated deserializers (`codec_read`) handle well-formed little-endian messages. Everything
else comes here: bags may hold big-endian messages, truncated ones, or bytes of another type.
"""

from __future__ import annotations

import array
import struct
import sys
from typing import Any, Literal

import numpy as np

from rsltrace.adapters.rclpy.wire.cdr_layout import least_size
from rsltrace.adapters.rclpy.wire.message_spec import (
    CHECK_SLOT,
    HEADER,
    Array,
    FieldType,
    Item,
    Message,
    Primitive,
    Sequence,
    Text,
)

_OTHER_ENCODINGS = {
    0x02: "PL_CDR",
    0x03: "PL_CDR",
    0x06: "XCDR2",
    0x07: "XCDR2",
    0x08: "delimited XCDR2",
    0x09: "delimited XCDR2",
    0x0A: "PL_CDR2",
    0x0B: "PL_CDR2",
}


def decode(spec: Message, raw: bytes) -> Any:
    """Return the message that CDR bytes hold, with the Python types that rclpy gives.

    Bytes after the end are ignored if they pad to a multiple of 4, or are those that rclpy's
    ``serialize_message`` returns too many (and that bags written from Python hold): it allots as
    many as it estimates, which for empty sequences and wstrings is more than it then writes.

    Raises ValueError naming the type and the offset (in bytes from the start of ``raw``) for
    another encoding than plain CDR, truncated or over-long bytes, and wstrings that are not UTF-16.
    """
    decoder = _Decoder(spec, bytes(raw))
    message = decoder.message(spec, "")
    decoder.finish()
    return message


class _Decoder:
    """Reads ``raw`` from ``position``, which counts from after the header as alignment does."""

    def __init__(self, spec: Message, raw: bytes) -> None:
        self.spec = spec
        self.raw = raw
        self.position = 0
        self.allotted = 0  # where rclpy's estimate of the size has got to: as far, or further
        self.end = len(raw) - len(HEADER)
        if self.end < 0:
            raise self.wrong(f"{len(raw)} bytes are too short for a CDR message; is it empty?")
        kind = raw[1]
        if raw[0] != 0 or kind > 1:
            name = _OTHER_ENCODINGS.get(kind) if raw[0] == 0 else None
            raise self.wrong(
                f"encapsulation 0x{raw[0]:02x}{kind:02x}{f' ({name})' if name else ''} "
                "is not supported; only plain CDR (0x0000 or 0x0001) is"
            )
        self.order: Literal["<", ">"] = "<" if kind else ">"

    def finish(self) -> None:
        """Raise ValueError if more follows the message than may."""
        if self.end not in (self.position, self.position + 3 & -4, self.allotted):
            raise self.wrong(
                f"the message ends at offset {self.position + 4}, but there are "
                f"{len(self.raw)} bytes; they are of another type or of another version of it"
            )

    def message(self, spec: Message, path: str) -> Any:
        message: Any = object.__new__(spec.cls)
        if spec.check_fields is not None:
            setattr(message, CHECK_SLOT, spec.check_fields)
        if not spec.fields:
            self.take(1, path)
        for field in spec.fields:
            where = f"{path}.{field.name}" if path else field.name
            setattr(message, field.slot, self.value(field.type, where))
        return message

    def value(self, type_: FieldType, path: str) -> Any:
        if isinstance(type_, Primitive):
            self.align(type_.size)
            return self.primitive(type_, self.take(type_.size, path), path)
        if isinstance(type_, Text):
            return self.text(type_, path)
        if isinstance(type_, Message):
            return self.message(type_, path)
        if isinstance(type_, Array):
            return self.array(type_, path)
        return self.sequence(type_, path)

    # -- bytes --------------------------------------------------------------------------------

    def align(self, size: int) -> None:
        self.position += -self.position % size
        self.allotted += -self.allotted % size

    def take(self, size: int, path: str) -> bytes:
        left = self.end - self.position
        if size > left:
            raise self.wrong(
                f"truncated: field {path!r} needs {size} bytes at offset {self.position + 4}, "
                f"but {f'only {left} are' if left > 0 else 'none is'} left"
            )
        start = self.position + len(HEADER)
        self.position += size
        self.allotted += size
        return self.raw[start : start + size]

    def count(self, path: str) -> int:
        self.align(4)
        return int(struct.unpack(self.order + "I", self.take(4, path))[0])

    # -- values -------------------------------------------------------------------------------

    def primitive(self, type_: Primitive, data: bytes, path: str) -> Any:
        if type_.name == "char":
            if data[0] > 127:
                raise self.wrong(f"field {path!r} is char {data[0]}, which rclpy cannot convert")
            return chr(data[0])
        return struct.unpack(self.order + type_.code, data)[0]

    def text(self, type_: Text, path: str) -> str:
        number = self.count(path)
        if not type_.wide:
            # As rclpy: up to the first NUL, and what is not UTF-8 is replaced.
            return self.take(number, path).split(b"\0", 1)[0].decode("utf-8", "replace")
        start = self.position + len(HEADER)
        self.allotted += 4  # for a terminator that wstrings do not have
        try:
            return unpack_wide(self.take(4 * number, path), self.order)
        except (UnicodeDecodeError, OverflowError) as error:
            raise self.wrong(
                f"field {path!r} at offset {start} is not UTF-16 text: {error}"
            ) from error

    def array(self, type_: Array, path: str) -> Any:
        item = type_.item
        if isinstance(item, Primitive) and item.typecode:
            self.align(item.size)
            data = self.take(type_.length * item.size, path)
            return np.frombuffer(data, item.dtype.newbyteorder(self.order)).astype(item.dtype)
        return [self.value(item, f"{path}[{index}]") for index in range(type_.length)]

    def sequence(self, type_: Sequence, path: str) -> Any:
        start = self.position + -self.position % 4
        number = self.count(path)
        item = type_.item
        if number and isinstance(item, Primitive):
            self.align(item.size)
        elif isinstance(item, Primitive):
            # The estimate aligns an empty sequence, though no item is written.
            self.allotted += -self.allotted % item.size
        self.plausible(item, number, start, path)
        if isinstance(item, Primitive) and item.typecode:
            values = array.array(item.typecode, self.take(number * item.size, path))
            if (self.order == "<") != (sys.byteorder == "little"):
                values.byteswap()
            return values
        return [self.value(item, f"{path}[{index}]") for index in range(number)]

    def plausible(self, item: Item, number: int, start: int, path: str) -> None:
        """Refuse a count that the bytes left cannot hold, before anything is allocated for it."""
        if number * least_size(item) > self.end - self.position:
            raise self.wrong(
                f"truncated: field {path!r} claims {number} items at offset {start + 4}, "
                f"but only {max(self.end - self.position, 0)} bytes follow"
            )

    def wrong(self, problem: str) -> ValueError:
        return ValueError(f"{self.spec.type_name}: {problem}")


def unpack_wide(data: bytes, order: str = "<") -> str:
    """Return the text of a wstring's characters, each a UTF-16 unit in four bytes.

    A byte order mark is obeyed and dropped, as rclpy does. Raises UnicodeDecodeError for what is
    not UTF-16, OverflowError for characters beyond 16 bits.
    """
    units = np.frombuffer(data, order + "u4")
    if len(units) and units.max() > 0xFFFF:
        raise OverflowError("a character is larger than 16 bits")
    return units.astype("=u2").tobytes().decode("utf-16")
