"""Generates the deserializer of a message class as Python source; the mirror of `encoder_source`.

The constructor is not called, as it would set every default through a checking property. Slots are
set instead, to values of the types that rclpy gives. For ``std_msgs/msg/Header`` it is about::

    def deserialize(raw):
        try:
            end = len(raw)
            header, v1, v2, n3 = unpack_from(raw, 0)
            if header != 256: raise Unusual
            e5 = 16 + n3
            v4 = raw[16:e5 - 1].decode()
            if "\\0" in v4 or raw[e5 - 1]: raise Unusual
            p = e5
            if p != end and (p + 3 & -4) != end: raise Unusual
            o6 = new_Time()
            ...
            return o7
        except Exception:
            pass
        return careful(raw)

Unusual bytes (big-endian, truncated, text that is not UTF-8, trailing bytes) are left to the
careful deserializer (`checked_codec.decode`), which also raises the errors.
"""

from __future__ import annotations

import array
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from rsltrace.adapters.rclpy.messages.checked_codec import decode, unpack_wide
from rsltrace.adapters.rclpy.messages.message_spec import (
    CHECK_SLOT,
    HEADER_PART,
    HEADER_PLACE,
    HEADER_VALUE,
    START,
    ArrayType,
    FieldType,
    FixedValue,
    ItemType,
    KnownOffset,
    MessageSpec,
    PrimitiveType,
    SequenceType,
    StringType,
    after_items,
    fixed_parts,
    fixed_size,
    lay_out,
    steady,
)
from rsltrace.adapters.rclpy.messages.source_text import FunctionSource, packer

_LARGE = 4096
"""Longer sequences are copied only once, through a memoryview."""

_OCTETS = tuple(bytes((value,)) for value in range(256))


def make_deserializer(spec: MessageSpec) -> Callable[[bytes], Any]:
    """Return a function from CDR bytes to a message, with the errors of `decode`."""
    return _Reader(spec).function()


class _Value(NamedTuple):
    """A value of a run, and the lines that convert it for its field."""

    name: str
    conversion: tuple[str, ...] = ()


class _Tree(NamedTuple):
    """A message to build once all its values have been read."""

    spec: MessageSpec
    values: list[str | _Tree]


class _Reader:
    """Writes the source. The offset in ``raw`` is the variable named ``base`` (if any) plus
    ``ahead``; ``place`` is what is known of it, counted from after the header."""

    def __init__(self, spec: MessageSpec) -> None:
        self.spec = spec
        self.source = FunctionSource(
            {
                "unpack_wide": unpack_wide,
                "large": _large_array,
                "array": array.array,
                "zeros": np.zeros,  # the guard redirects ``np.empty`` and ``np.ndarray``
                "OCTETS": _OCTETS,
            }
        )
        self.base = ""
        self.ahead = 0
        self.place = HEADER_PLACE
        self.run = [HEADER_PART]
        self.values = [_Value("header", (f"if header != {HEADER_VALUE}: raise Unusual",))]

    def function(self) -> Callable[[bytes], Any]:
        line = self.source.line
        size = fixed_size(self.spec)
        if size is None or size % 4:
            line("end = len(raw)")
        tree = self.message(self.spec)
        self.flush(whole=size is not None and size % 4 == 0)
        if size is None or size % 4:
            here = self.offset()
            line(f"if {here} != end and ({here} + 3 & -4) != end: raise Unusual")
        line(f"return {self.build(tree)}")
        careful = partial(decode, self.spec)
        return self.source.compile("deserialize", "raw", careful, self.spec.type_name)

    # -- values -------------------------------------------------------------------------------

    def message(self, spec: MessageSpec) -> _Tree:
        if not spec.fields:
            self.run.append(FixedValue("x", 1, 1))
        return _Tree(spec, [self.value(field.type) for field in spec.fields])

    def value(self, type_: FieldType) -> str | _Tree:
        if isinstance(type_, PrimitiveType):
            conversion = "{0} = {0}.decode('ascii')" if type_.name == "char" else ""
            return self.put(FixedValue(type_.code, type_.size, type_.size), conversion)
        if isinstance(type_, StringType):
            return self.text(type_)
        if isinstance(type_, MessageSpec):
            return self.message(type_)
        if isinstance(type_, ArrayType):
            return self.array(type_)
        return self.sequence(type_)

    def text(self, type_: StringType) -> str:
        number = self.put(FixedValue("I", 4, 4))
        self.flush()
        value, end = self.source.variable("v"), self.source.variable("e")
        here = self.offset()
        if type_.wide:
            self.span(end, here, f"4 * {number}")
            self.source.line(f"{value} = unpack_wide(raw[{here}:{end}])")
            self.jump(end, self.place.moved_by_multiple(4))
            return value
        # No check of the length: an index past the end raises.
        self.source.line(f"{end} = {here} + {number}")
        self.source.line(f"{value} = raw[{here}:{end} - 1].decode()")
        self.source.line(f"if '\\0' in {value} or raw[{end} - 1]: raise Unusual")
        self.jump(end, self.place.moved_by_multiple(1))
        return value

    def array(self, type_: ArrayType) -> str:
        item, length = type_.item, type_.length
        if not isinstance(item, PrimitiveType):
            self.flush()
            return self.loop(item, str(length), steady(item, self.place))
        size = item.size * length
        if not item.typecode:
            return self.put(
                FixedValue(f"{size}s", size, 1), "{0} = " + _LISTS[item.name].format("{0}")
            )
        fill = self.source.constant(packer(f"{size}s").pack_into)
        data = self.source.variable("b")
        value = self.source.variable("v")
        self.run.append(FixedValue(f"{size}s", size, item.size))
        dtype = self.source.constant(item.dtype)
        # Twice as fast as frombuffer and copy, for the usual short arrays.
        lines = (f"{value} = zeros({length}, {dtype})", f"{fill}({value}, 0, {data})")
        self.values.append(_Value(data, lines))
        return value

    def sequence(self, type_: SequenceType) -> str:
        item = type_.item
        number = self.put(FixedValue("I", 4, 4))
        self.flush()
        if isinstance(item, PrimitiveType):
            place = after_items(item, self.place)
            start, end = self.items(number, item.size, item.size)
            value = self.source.variable("v")
            if item.typecode:
                few = f"array({item.typecode!r}, raw[{start}:{end}])"
                many = f"large({item.typecode!r}, raw, {start}, {end})"
                limit = _LARGE // item.size
                self.source.line(f"{value} = {few} if {number} < {limit} else {many}")
            else:
                self.source.line(f"{value} = " + _LISTS[item.name].format(f"raw[{start}:{end}]"))
            self.jump(end, place)
            return value
        parts = fixed_parts(item)
        if parts is not None and isinstance(item, MessageSpec) and item.fields:
            widest = max(part.alignment for part in parts)
            _, size = lay_out(parts, 0)
            if parts[0].alignment == widest and size % widest == 0:
                return self.strided(item, number, size, widest)
        return self.loop(item, number, steady(item, self.place))

    def strided(self, item: MessageSpec, number: str, size: int, widest: int) -> str:
        """Read items of the same layout, without padding between them."""
        place = after_items(item, self.place)
        start, end = self.items(number, size, widest)
        values, add = self.new_list()
        self.place = START
        tree = self.message(item)
        codes, _ = lay_out(self.run, 0)
        unpack = self.source.constant(packer(codes).iter_unpack)
        with self.source.block(f"for {self.targets()} in {unpack}(raw[{start}:{end}]):"):
            self.convert()
            self.source.line(f"{add}({self.build(tree)})")
        self.jump(end, place)
        return values

    def items(self, number: str, size: int, alignment: int) -> tuple[str, str]:
        """Return the offsets of the first item and after the last one."""
        start = here = self.offset()
        if self.place.aligned(alignment) != self.place:
            start = self.source.variable("s")
            self.source.line(f"{start} = {self.aligned(alignment)} if {number} else {here}")
        end = self.source.variable("e")
        self.span(end, start, f"{size} * {number}")
        return start, end

    def span(self, end: str, start: str, size: str) -> None:
        self.source.line(f"{end} = {start} + {size}")
        self.source.line(f"if {end} > end: raise Unusual")

    def loop(self, item: ItemType, number: str, place: KnownOffset) -> str:
        """Read items one by one; ``place`` holds at the start of every turn."""
        values, add = self.new_list()
        self.settle(place)
        with self.source.block(f"for _ in range({number}):"):
            value = self.value(item)
            self.flush()
            self.source.line(f"{add}({self.build(value)})")
            self.settle(place)
        return values

    def new_list(self) -> tuple[str, str]:
        values, add = self.source.variable("v"), self.source.variable("add")
        self.source.line(f"{values} = []")
        self.source.line(f"{add} = {values}.append")
        return values, add

    def build(self, value: str | _Tree) -> str:
        """Write the construction of a message; return its name."""
        if isinstance(value, str):
            return value
        names = [self.build(part) for part in value.values]
        name = self.source.variable("o")
        self.source.line(f"{name} = {self.source.constant(_maker(value.spec.cls))}()")
        if value.spec.check_fields is not None:
            self.source.line(f"{name}.{CHECK_SLOT} = {value.spec.check_fields}")
        for field, part in zip(value.spec.fields, names, strict=True):
            self.source.line(f"{name}.{field.slot} = {part}")
        return name

    # -- bytes --------------------------------------------------------------------------------

    def put(self, part: FixedValue, conversion: str = "") -> str:
        name = self.source.variable("v")
        self.run.append(part)
        lines = (conversion.format(name),) if conversion else ()
        self.values.append(_Value(name, lines))
        return name

    def offset(self) -> str:
        if not self.base:
            return str(self.ahead)
        return f"{self.base} + {self.ahead}" if self.ahead else self.base

    def aligned(self, size: int) -> str:
        """Return an expression for the offset after padding; the header's 4 bytes do not count."""
        if size < 8:
            return f"{self.offset()} + {size - 1} & -{size}"
        return f"({self.offset()} + 3 & -8) + 4"

    def jump(self, base: str, place: KnownOffset) -> None:
        """Go on at the offset in the variable ``base``."""
        self.base, self.ahead, self.place = base, 0, place

    def settle(self, place: KnownOffset) -> None:
        """Put the offset into ``p`` and forget all else but ``place``, at the edges of a loop."""
        assert self.place.joined(place) == place, "a loop's invariant does not hold"
        if self.offset() != "p":
            self.source.line(f"p = {self.offset()}")
        self.jump("p", place)

    def flush(self, whole: bool = False) -> None:
        """Read the gathered run of fixed-size values; ``whole`` if it is all of ``raw``."""
        if not self.run:
            return
        widest = max(part.alignment for part in self.run)
        if self.place.modulus < widest == self.run[0].alignment:
            start = self.source.variable("s")
            self.source.line(f"{start} = {self.aligned(widest)}")
            self.jump(start, self.place.aligned(widest))
        if self.place.modulus >= widest:
            codes, size = lay_out(self.run, self.place.rest)
            if whole:
                unpack = f"{self.source.constant(packer(codes).unpack)}(raw)"
            else:
                unpack = f"{self.source.constant(packer(codes).unpack_from)}(raw, {self.offset()})"
            self.source.line(f"{self.targets()} = {unpack}" if self.values else unpack)
            self.ahead += size
            self.place = self.place.moved(size)
        else:
            self.flush_variants(widest)
        self.convert()

    def flush_variants(self, widest: int) -> None:
        layouts = [lay_out(self.run, rest) for rest in range(widest)]
        index, end = self.source.variable("i"), self.source.variable("e")
        self.source.line(f"{index} = {self.offset()} - 4 & {widest - 1}")
        unpacks = self.source.constant(tuple(packer(codes).unpack_from for codes, _ in layouts))
        sizes = self.source.constant(tuple(size for _, size in layouts))
        unpack = f"{unpacks}[{index}](raw, {self.offset()})"
        self.source.line(f"{self.targets()} = {unpack}" if self.values else unpack)
        self.source.line(f"{end} = {self.offset()} + {sizes}[{index}]")
        place = self.place
        for part in self.run:
            place = place.aligned(part.alignment).moved(part.size)
        self.jump(end, place)

    def targets(self) -> str:
        return ", ".join(value.name for value in self.values) + ","

    def convert(self) -> None:
        """Write the conversions of the run just read, and begin a new one."""
        for value in self.values:
            for text in value.conversion:
                self.source.line(text)
        self.run, self.values = [], []


_LISTS = {
    "boolean": "list(map(bool, {}))",
    "octet": "[OCTETS[octet] for octet in {}]",
    "char": "list({}.decode('ascii'))",
}
"""Conversions of an array's or sequence's bytes to the list that rclpy gives."""


@cache
def _maker(cls: type) -> Callable[[], Any]:
    return partial(object.__new__, cls)


def _large_array(typecode: str, raw: bytes, start: int, end: int) -> array.array[Any]:
    values = array.array(typecode)
    values.frombytes(memoryview(raw)[start:end])
    return values
