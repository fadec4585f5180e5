"""Generates the serializer of a message class as Python source.

Serializing is the hottest code of a simulation, so each class gets its own function. Nested
messages are flattened, and adjacent values of fixed size become one precompiled `struct.Struct`
with zeros as padding. After a string or sequence, the position modulo 8 selects the struct. For
``std_msgs/msg/Header`` it is about::

    def serialize(m):
        try:
            if type(m) is not Header: raise Unusual
            v0 = m._stamp
            v1 = v0._sec
            v2 = v0._nanosec
            v3 = m._frame_id
            b4 = encode(v3)
            if not (type(v0) is Time and isinstance(v1, int) and isinstance(v2, int)
                    and 0 not in b4): raise Unusual
            return pack(256, v1, v2, len(b4) + 1) + b4 + NUL
        except Exception:
            pass
        return careful(m)

Unusual values are left to the careful serializer (`checked_codec.encode`).
"""

from __future__ import annotations

import array
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from rsltrace.adapters.rclpy.messages.checked_codec import encode, pack_wide
from rsltrace.adapters.rclpy.messages.message_spec import (
    HEADER,
    HEADER_PART,
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
    first_alignment,
    lay_out,
    steady,
)
from rsltrace.adapters.rclpy.messages.source_text import FunctionSource, packer

_ONLY_BOOL = frozenset({bool})


def make_serializer(spec: MessageSpec) -> Callable[[Any], bytes]:
    """Return a function from a message to its CDR bytes, with the errors of `encode`."""
    return _Writer(spec).function()


class _Writer:
    """Writes the source. ``place`` is what is known of the position; the generated variable ``p``
    holds (position - ``ahead``) modulo 8 wherever ``place`` does not tell all of it."""

    def __init__(self, spec: MessageSpec) -> None:
        self.spec = spec
        self.source = FunctionSource(
            {
                "encode": str.encode,
                "pack_wide": pack_wide,
                "join": b"".join,
                "ONLY_BOOL": _ONLY_BOOL,
                "PADS": tuple(bytes(-place % 8) for place in range(8)),
            }
        )
        self.place = START
        self.ahead = 0
        self.run: list[FixedValue] = []
        self.arguments: list[str] = []
        self.checks: list[str] = []
        self.parts: list[str] = []
        self.begun = False
        self.bulky = False
        self.looping = _needs_loop(spec)

    def function(self) -> Callable[[Any], bytes]:
        source = self.source
        if self.looping:
            source.line("out = []")
            source.line("add = out.append")
        source.line(f"if type(m) is not {source.constant(self.spec.cls)}: raise Unusual")
        self.message(self.spec, "m")
        self.flush()
        if self.looping:
            source.line("return join(out)")
        elif len(self.parts) <= 3 and not self.bulky:
            source.line(f"return {' + '.join(self.parts)}")
        else:
            source.line(f"return join(({', '.join(self.parts)},))")
        careful = partial(encode, self.spec)
        return source.compile("serialize", "m", careful, self.spec.type_name)

    # -- values -------------------------------------------------------------------------------

    def message(self, spec: MessageSpec, name: str) -> None:
        if not spec.fields:
            self.put(FixedValue("x", 1, 1))
        for field in spec.fields:
            value = self.source.variable("v")
            self.source.line(f"{value} = {name}.{field.slot}")
            self.value(field.type, value)

    def value(self, type_: FieldType, value: str) -> None:
        if isinstance(type_, PrimitiveType):
            self.primitive(type_, value)
        elif isinstance(type_, StringType):
            self.text(type_, value)
        elif isinstance(type_, MessageSpec):
            self.checks.append(f"type({value}) is {self.source.constant(type_.cls)}")
            self.message(type_, value)
        elif isinstance(type_, ArrayType):
            self.array(type_, value)
        else:
            self.sequence(type_, value)

    def primitive(self, type_: PrimitiveType, value: str) -> None:
        if type_.name == "char":
            self.checks.append("False")  # only IDL files can have it; no fast code
        elif type_.name == "boolean":
            self.checks.append(f"type({value}) is bool")
        elif type_.name != "octet":  # struct itself insists on bytes of length 1
            self.checks.append(f"isinstance({value}, {'float' if type_.code in 'fd' else 'int'})")
        self.put(FixedValue(type_.code, type_.size, type_.size), value)

    def text(self, type_: StringType, value: str) -> None:
        data = self.source.variable("b")
        if type_.wide:
            self.source.line(f"{data} = pack_wide({value})")
            self.put(FixedValue("I", 4, 4), f"len({data}) // 4")
            self.flush()
            self.emit(data)
            self.move(f"len({data})", 4)
            return
        self.source.line(f"{data} = encode({value})")
        self.checks.append(f"0 not in {data}")
        self.put(FixedValue("I", 4, 4), f"len({data}) + 1")
        self.flush()
        self.emit(data)
        self.move(f"len({data})", 1)
        self.put(FixedValue("x", 1, 1))  # the NUL; it joins what follows

    def array(self, type_: ArrayType, value: str) -> None:
        item, length = type_.item, type_.length
        if isinstance(item, PrimitiveType) and item.typecode:
            dtype = self.source.constant(item.dtype)
            self.checks += [
                f"{value}.dtype is {dtype}",
                f"{value}.ndim == 1",
                f"len({value}) == {length}",
            ]
            size = item.size * length
            self.put(FixedValue(f"{size}s", size, item.size), f"{value}.tobytes()")
            return
        self.need_list(value)
        self.source.line(f"if len({value}) != {length}: raise Unusual")
        if isinstance(item, PrimitiveType):
            self.put(FixedValue(f"{length}s", length, 1), self.flags(item, value))
        else:
            self.flush()
            self.loop(item, value, steady(item, self.place))

    def sequence(self, type_: SequenceType, value: str) -> None:
        item = type_.item
        numbers = isinstance(item, PrimitiveType) and bool(item.typecode)
        if numbers:
            assert isinstance(item, PrimitiveType)
            array_type = self.source.constant(array.array)
            self.checks += [
                f"type({value}) is {array_type}",
                f"{value}.typecode == {item.typecode!r}",
            ]
        else:
            self.need_list(value)
        if type_.bound is not None:
            self.checks.append(f"len({value}) <= {type_.bound}")
        self.put(FixedValue("I", 4, 4), f"len({value})")
        self.flush()
        if isinstance(item, PrimitiveType) and item.size < 8:
            self.emit(value if numbers else self.flags(item, value), bulk=True)
            self.move(f"{item.size} * len({value})", item.size)
        elif isinstance(item, PrimitiveType):
            with self.aligned_if(value):
                self.emit(value, bulk=True)
        elif first_alignment(item) == 8 and steady(item, START) == START:
            with self.aligned_if(value):
                self.loop(item, value, START)
        else:
            self.loop(item, value, steady(item, self.place))

    @contextmanager
    def aligned_if(self, value: str) -> Iterator[None]:
        """Write items that begin and end at a multiple of 8, if there are any.

        An empty sequence ends after its count: no padding follows it.
        """
        place, ahead = self.place, self.ahead
        if place == START:
            yield
            assert self.place == START
            return
        if place.modulus == 8:
            self.emit(f"PADS[{place.rest}] if {value} else b''")
        else:
            self.emit(f"PADS[p + {ahead} & 7] if {value} else b''", uses_p=True)
        self.place = START
        yield
        assert self.place == START, "items do not end at a multiple of 8"
        if place.modulus == 8:
            self.source.assign(f"p = 0 if {value} else {place.rest}")
        else:
            self.source.shift(f"p = 0 if {value} else p + {ahead}")
        self.ahead = 0
        self.place = place.joined(START)

    def loop(self, item: ItemType, sequence: str, place: KnownOffset) -> None:
        """Write a loop over items; ``place`` holds at every turn."""
        if not self.begun:
            self.emit(repr(HEADER))
            self.begun = True
        self.settle(place)
        value = self.source.variable("v")
        with self.source.block(f"for {value} in {sequence}:"):
            self.value(item, value)
            self.flush()
            self.settle(place)

    def flags(self, item: PrimitiveType, value: str) -> str:
        """Return the name of the bytes of a list of ``boolean``, ``octet`` or ``char``."""
        data = self.source.variable("b")
        if item.name == "boolean":
            self.source.line(f"if not ONLY_BOOL.issuperset(map(type, {value})): raise Unusual")
            self.source.line(f"{data} = bytes({value})")
        elif item.name == "octet":
            pack = self.source.constant(_pack_octets)
            self.source.line(f"{data} = {pack}({value})")
        else:
            self.source.line(f"if {value}: raise Unusual")
            self.source.line(f"{data} = b''")
        return data

    def need_list(self, value: str) -> None:
        # At once, not with the other checks, as the next lines iterate over it.
        self.source.line(
            f"if type({value}) is not list and type({value}) is not tuple: raise Unusual"
        )

    # -- bytes --------------------------------------------------------------------------------

    def put(self, part: FixedValue, argument: str | None = None) -> None:
        self.run.append(part)
        if argument is not None:
            self.arguments.append(argument)

    def emit(self, part: str, *, bulk: bool = False, uses_p: bool = False) -> None:
        """Append an expression to the output. ``bulk`` ones may be large, and no bytes object."""
        if self.looping:
            (self.source.use if uses_p else self.source.line)(f"add({part})")
            return
        self.bulky |= bulk
        if not part.isidentifier() and not part.startswith("b'"):
            name = self.source.variable("b")
            (self.source.use if uses_p else self.source.line)(f"{name} = {part}")
            part = name
        self.parts.append(part)

    def flush(self) -> None:
        """Emit the gathered checks and the run of fixed-size values."""
        if self.checks:
            self.source.line(f"if not ({' and '.join(self.checks)}): raise Unusual")
            self.checks = []
        if not self.run:
            return
        arguments = ", ".join(self.arguments)
        widest = max(part.alignment for part in self.run)
        if self.place.modulus >= widest:
            codes, size = lay_out(self.run, self.place.rest)
            if not self.begun:
                codes = HEADER_PART.code + codes
                arguments = f"{HEADER_VALUE}, {arguments}" if arguments else str(HEADER_VALUE)
            if arguments:
                self.emit(f"{self.source.constant(packer(codes).pack)}({arguments})")
            else:
                self.emit(repr(bytes(size)))
            self.ahead += size
            self.place = self.place.moved(size)
        else:
            self.flush_variants(arguments, widest)
        self.begun = True
        self.run, self.arguments = [], []

    def flush_variants(self, arguments: str, widest: int) -> None:
        layouts = [lay_out(self.run, rest) for rest in range(widest)]
        index = self.source.variable("i")
        self.source.use(f"{index} = p + {self.ahead % 8} & {widest - 1}")
        if arguments:
            packs = tuple(packer(codes).pack for codes, _ in layouts)
            self.emit(f"{self.source.constant(packs)}[{index}]({arguments})")
        else:
            blanks = tuple(bytes(size) for _, size in layouts)
            self.emit(f"{self.source.constant(blanks)}[{index}]")
        place = self.place
        for part in self.run:
            place = place.aligned(part.alignment).moved(part.size)
        self.place = place
        if place.modulus < 8:
            sizes = self.source.constant(tuple(size for _, size in layouts))
            self.source.shift(f"p += {self.ahead % 8} + {sizes}[{index}]")
            self.ahead = 0

    def move(self, size: str, unit: int) -> None:
        """The position moves on by ``size``, an expression for some multiple of ``unit`` bytes."""
        self.fix_p(size)
        self.place = self.place.moved_by_multiple(unit)

    def fix_p(self, size: str = "") -> None:
        """Make ``p`` the position modulo 8, plus ``size``."""
        if self.place.modulus == 8:
            self.source.assign(f"p = {self.place.rest}{f' + {size}' if size else ''}")
        elif size or self.ahead % 8:
            self.source.shift(f"p += {self.ahead % 8}{f' + {size}' if size else ''}")
        self.ahead = 0

    def settle(self, place: KnownOffset) -> None:
        """Forget all about the position but ``place``, at the edges of a loop."""
        assert self.place.joined(place) == place, "a loop's invariant does not hold"
        if place.modulus < 8:
            self.fix_p()
        self.place = place


def _needs_loop(type_: FieldType) -> bool:
    if isinstance(type_, MessageSpec):
        return any(_needs_loop(field.type) for field in type_.fields)
    if isinstance(type_, ArrayType | SequenceType):
        return not isinstance(type_.item, PrimitiveType)
    return False


def _pack_octets(values: list[bytes] | tuple[bytes, ...]) -> bytes:
    return struct.pack(f"{len(values)}c", *values)
