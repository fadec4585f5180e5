"""The careful serializer and deserializer: field by field, with errors that name field and place.

The generated functions (`encoder_source`, `decoder_source`) handle only usual messages. Other
values that user code stored in fields come here. They are converted as by rclpy's C code, or
refused where that raises, aborts or reads foreign memory. Bags may hold big-endian messages,
truncated ones, or bytes of another type.
"""

from __future__ import annotations

import array
import struct
import sys
from typing import Any, Literal

import numpy as np

from rsltrace.adapters.rclpy.messages.message_spec import (
    CHECK_SLOT,
    HEADER,
    ArrayType,
    FieldType,
    ItemType,
    MessageSpec,
    PrimitiveType,
    SequenceType,
    StringType,
    least_size,
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


def decode(spec: MessageSpec, raw: bytes) -> Any:
    """Return the message in CDR bytes, with the Python types of rclpy.

    Bytes after the end are ignored if they pad to a multiple of 4, or if rclpy's
    ``serialize_message`` (and so bags written from Python) adds them: it returns as many bytes as
    it estimates, which is too many for empty sequences and wstrings.

    Raises ValueError naming the type and the offset in ``raw``, for other encodings than plain CDR,
    truncated or over-long bytes, and wstrings that are not UTF-16.
    """
    decoder = _Decoder(spec, bytes(raw))
    message = decoder.message(spec, "")
    decoder.finish()
    return message


class _Decoder:
    """Reads ``raw`` from ``position``, which counts from after the header as alignment does."""

    def __init__(self, spec: MessageSpec, raw: bytes) -> None:
        self.spec = spec
        self.raw = raw
        self.position = 0
        self.allotted = 0  # rclpy's estimate of the position: the same, or larger
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
        if self.end not in (self.position, self.position + 3 & -4, self.allotted):
            raise self.wrong(
                f"the message ends at offset {self.position + 4}, but there are "
                f"{len(self.raw)} bytes; they are of another type or of another version of it"
            )

    def message(self, spec: MessageSpec, path: str) -> Any:
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
        if isinstance(type_, PrimitiveType):
            self.align(type_.size)
            return self.primitive(type_, self.take(type_.size, path), path)
        if isinstance(type_, StringType):
            return self.text(type_, path)
        if isinstance(type_, MessageSpec):
            return self.message(type_, path)
        if isinstance(type_, ArrayType):
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

    def primitive(self, type_: PrimitiveType, data: bytes, path: str) -> Any:
        if type_.name == "char":
            if data[0] > 127:
                raise self.wrong(f"field {path!r} is char {data[0]}, which rclpy cannot convert")
            return chr(data[0])
        return struct.unpack(self.order + type_.code, data)[0]

    def text(self, type_: StringType, path: str) -> str:
        number = self.count(path)
        if not type_.wide:
            # As rclpy: up to the first NUL, and invalid UTF-8 is replaced.
            return self.take(number, path).split(b"\0", 1)[0].decode("utf-8", "replace")
        start = self.position + len(HEADER)
        self.allotted += 4  # for a terminator that wstrings do not have
        try:
            return unpack_wide(self.take(4 * number, path), self.order)
        except (UnicodeDecodeError, OverflowError) as error:
            raise self.wrong(
                f"field {path!r} at offset {start} is not UTF-16 text: {error}"
            ) from error

    def array(self, type_: ArrayType, path: str) -> Any:
        item = type_.item
        if isinstance(item, PrimitiveType) and item.typecode:
            self.align(item.size)
            data = self.take(type_.length * item.size, path)
            return np.frombuffer(data, item.dtype.newbyteorder(self.order)).astype(item.dtype)
        return [self.value(item, f"{path}[{index}]") for index in range(type_.length)]

    def sequence(self, type_: SequenceType, path: str) -> Any:
        start = self.position + -self.position % 4
        number = self.count(path)
        item = type_.item
        if number and isinstance(item, PrimitiveType):
            self.align(item.size)
        elif isinstance(item, PrimitiveType):
            # The estimate aligns an empty sequence, though no item is written.
            self.allotted += -self.allotted % item.size
        self.plausible(item, number, start, path)
        if isinstance(item, PrimitiveType) and item.typecode:
            values = array.array(item.typecode, self.take(number * item.size, path))
            if (self.order == "<") != (sys.byteorder == "little"):
                values.byteswap()
            return values
        return [self.value(item, f"{path}[{index}]") for index in range(number)]

    def plausible(self, item: ItemType, number: int, start: int, path: str) -> None:
        """Refuse a count that exceeds the remaining bytes, before memory is allocated for it."""
        if number * least_size(item) > self.end - self.position:
            raise self.wrong(
                f"truncated: field {path!r} claims {number} items at offset {start + 4}, "
                f"but only {max(self.end - self.position, 0)} bytes follow"
            )

    def wrong(self, problem: str) -> ValueError:
        return ValueError(f"{self.spec.type_name}: {problem}")


def unpack_wide(data: bytes, order: str = "<") -> str:
    """Return the text of a wstring, whose characters are UTF-16 units in four bytes each.

    As in rclpy, a byte order mark is obeyed and dropped. Raises UnicodeDecodeError if it is not
    UTF-16, OverflowError for characters beyond 16 bits.
    """
    units = np.frombuffer(data, order + "u4")
    if len(units) and units.max() > 0xFFFF:
        raise OverflowError("a character is larger than 16 bits")
    return units.astype("=u2").tobytes().decode("utf-16")


_UINT32 = struct.Struct("<I")
_LONG = 1 << 63


def encode(spec: MessageSpec, message: Any, *, fill: int = 0) -> bytes:
    """Return the CDR bytes of a message, with ``fill`` (0 to 255) as padding.

    Raises TypeError or ValueError naming message, field and value, if rclpy cannot serialize it
    either.
    """
    encoder = _Encoder(spec.type_name, fill)
    if not _is_instance(message, spec):
        raise TypeError(
            f"expected a message of type {spec.type_name}, "
            f"got {type(message).__module__}.{type(message).__qualname__}"
        )
    encoder.message(spec, message, "")
    return HEADER + bytes(encoder.data)


class _Encoder:
    """Appends to ``data``; positions are its length."""

    def __init__(self, type_name: str, fill: int) -> None:
        self.type_name = type_name
        self.fill = fill
        self.data = bytearray()

    def message(self, spec: MessageSpec, message: Any, path: str) -> None:
        if not spec.fields:
            self.data.append(0)  # CDR has no empty structs; rosidl puts one zero byte into them
        for field in spec.fields:
            where = f"{path}.{field.name}" if path else field.name
            try:
                value = getattr(message, field.name)
            except AttributeError:
                raise self.wrong_value(where, "has no value: its slot is empty") from None
            self.value(field.type, value, where)

    def value(self, type_: FieldType, value: Any, path: str) -> None:
        if isinstance(type_, PrimitiveType):
            self.align(type_.size)
            self.data += self.primitive(type_, value, path)
        elif isinstance(type_, StringType):
            self.text(type_, value, path)
        elif isinstance(type_, MessageSpec):
            if not _is_instance(value, type_):
                raise self.wrong_type(path, f"a {type_.type_name} message", value)
            self.message(type_, value, path)
        elif isinstance(type_, ArrayType):
            self.array(type_, value, path)
        else:
            self.sequence(type_, value, path)

    def align(self, size: int) -> None:
        self.data += bytes((self.fill,)) * (-len(self.data) % size)

    def count(self, number: int) -> None:
        self.align(4)
        self.data += _UINT32.pack(number)

    # -- single values ------------------------------------------------------------------------

    def primitive(self, type_: PrimitiveType, value: Any, path: str) -> bytes:
        if type_.name == "boolean":
            # rclpy compares with Py_True: 1 and numpy.True_ would silently become False.
            if value is not True and value is not False:
                raise self.wrong_type(path, "a bool (numpy.bool_ and integers are not)", value)
            return b"\1" if value else b"\0"
        if type_.name == "octet":
            if not isinstance(value, bytes):
                raise self.wrong_type(path, "bytes of length 1", value)
            return value[:1] or b"\0"
        if type_.name == "char":
            if not isinstance(value, str):
                raise self.wrong_type(path, "a str of length 1", value)
            return self.utf8(value, path)[:1] or b"\0"
        if type_.code in "fd":
            return self.real(type_, value, path)
        return self.integer(type_, value, path)

    def real(self, type_: PrimitiveType, value: Any, path: str) -> bytes:
        # PyFloat_AS_DOUBLE on anything else reads whatever bytes the object has there.
        if not isinstance(value, float):
            raise self.wrong_type(path, "a float (convert integers and numpy.float32)", value)
        try:
            return struct.pack("<" + type_.code, value)
        except OverflowError:  # too large for float32: C's conversion gives infinity
            return struct.pack("<f", float("inf") if value > 0 else float("-inf"))

    def integer(self, type_: PrimitiveType, value: Any, path: str) -> bytes:
        if not isinstance(value, int):
            raise self.wrong_type(path, "an int (numpy integers are not)", value)
        bits = 8 * type_.size
        signed = type_.code.islower()
        # C converts by way of a 64-bit long and then keeps the low bits.
        low, high = (-_LONG, _LONG) if signed else (0, 2 * _LONG)
        if not low <= value < high:
            raise self.wrong_value(path, f"is {value}, which is out of range for {type_.name}")
        return (value & ((1 << bits) - 1)).to_bytes(type_.size, "little")

    def utf8(self, value: str, path: str) -> bytes:
        try:
            return str.encode(value)  # not value.encode, which a subclass may have replaced
        except UnicodeEncodeError as error:
            raise self.with_place(error, path) from None

    def text(self, type_: StringType, value: Any, path: str) -> None:
        if not isinstance(value, str):
            raise self.wrong_type(path, "a str", value)
        if type_.wide:
            try:
                wide = pack_wide(value)
            except UnicodeEncodeError as error:
                raise self.with_place(error, path) from None
            self.count(len(wide) // 4)
            self.data += wide
        else:
            # rclpy hands C strings over, which end at the first NUL.
            encoded = self.utf8(value, path).split(b"\0", 1)[0] + b"\0"
            self.count(len(encoded))
            self.data += encoded

    # -- many values --------------------------------------------------------------------------

    def array(self, type_: ArrayType, value: Any, path: str) -> None:
        if isinstance(type_.item, PrimitiveType) and type_.item.typecode:
            self.align(type_.item.size)
            self.data += self.numbers(type_.item, type_.length, value, path)
            return
        items = self.items(value, path)
        if len(items) < type_.length:
            raise self.wrong_value(path, f"has {len(items)} items instead of {type_.length}")
        # rclpy takes the first ones and ignores the others.
        self.each(type_.item, items[: type_.length], path)

    def numbers(self, item: PrimitiveType, length: int, value: Any, path: str) -> bytes:
        expected = f"a numpy array of {length} {item.dtype}"
        if type(value) is not np.ndarray:
            raise self.wrong_type(path, expected, value)
        if value.dtype != item.dtype or value.ndim != 1 or len(value) < length:
            raise self.wrong_value(
                path, f"must be {expected}, but is one of {value.dtype} with shape {value.shape}"
            )
        return value[:length].tobytes()

    def sequence(self, type_: SequenceType, value: Any, path: str) -> None:
        raw = self.raw_items(type_.item, value, path)
        if raw is not None:
            assert isinstance(type_.item, PrimitiveType)
            number = len(raw) // type_.item.size
            self.bounded(type_, number, path)
            self.count(number)
            if number:
                self.align(type_.item.size)
            self.data += raw
            return
        if isinstance(value, dict) or not hasattr(type(value), "__len__"):
            raise self.wrong_type(path, "a sequence", value)
        items = self.items(value, path)
        self.bounded(type_, len(items), path)
        self.count(len(items))
        self.each(type_.item, items, path)

    def raw_items(self, item: ItemType, value: Any, path: str) -> bytes | None:
        """Return the bytes of a buffer, which rclpy copies; None if it is not one."""
        if not isinstance(item, PrimitiveType):
            return None
        try:
            view = memoryview(value)
        except TypeError:
            return None
        if not view.c_contiguous:
            raise self.wrong_value(path, "is an array that is not C-contiguous; copy it")
        if view.nbytes % item.size:
            raise self.wrong_value(
                path, f"is a buffer of {view.nbytes} bytes, not a whole number of {item.name}"
            )
        raw = view.tobytes()
        if item.name == "boolean" and raw.translate(None, b"\0\1"):
            raise self.wrong_value(path, "is a buffer with bytes other than 0 and 1 for bool")
        return raw

    def items(self, value: Any, path: str) -> list[Any]:
        try:
            return list(value)
        except TypeError:
            raise self.wrong_type(path, "a sequence", value) from None

    def each(self, item: ItemType, items: list[Any], path: str) -> None:
        for index, value in enumerate(items):
            self.value(item, value, f"{path}[{index}]")

    def bounded(self, type_: SequenceType, number: int, path: str) -> None:
        if type_.bound is not None and number > type_.bound:
            raise self.wrong_value(path, f"has {number} items, more than its bound {type_.bound}")

    # -- errors -------------------------------------------------------------------------------

    def wrong_type(self, path: str, expected: str, value: Any) -> TypeError:
        shown = repr(value)
        shown = shown if len(shown) <= 60 else shown[:57] + "..."
        return TypeError(
            f"{self.type_name}: field {path!r} must be {expected}, "
            f"but is {type(value).__name__} {shown}"
        )

    def with_place(self, error: UnicodeEncodeError, path: str) -> UnicodeEncodeError:
        error.reason += f" ({self.type_name}: field {path!r})"
        return error

    def wrong_value(self, path: str, problem: str) -> ValueError:
        return ValueError(f"{self.type_name}: field {path!r} {problem}")


def pack_wide(value: str) -> bytes:
    """Return a wstring's UTF-16 units in four bytes each; raise UnicodeEncodeError for lone
    surrogates, as rclpy does."""
    units = np.frombuffer(str.encode(value, "utf-16-le"), "<u2")
    return units.astype("<u4").tobytes()


def _is_instance(value: Any, spec: MessageSpec) -> bool:
    # rclpy's own test: the beginning of the class's name, so that no subclass passes.
    cls = type(value)
    return cls is spec.cls or f"{cls.__module__}.{cls.__name__}".startswith(spec.python_name)
