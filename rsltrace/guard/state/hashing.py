"""A hash of a node's state: equal for equal states, whatever the addresses and orders.

The state is written as canonical bytes and hashed with XXH3-64. Values count, not objects: two
equal lists hash equally, shared or not. -0.0 equals 0.0, every NaN is the same, sets have no order
(dicts have one that programs see). Array data is hashed in place at the speed of memory. What has
no value (locks, generators, handles of the middleware) is left out and listed.
"""

from __future__ import annotations

import array
import collections
import datetime
import decimal
import enum
import fractions
import functools
import pathlib
import struct
import sys
import types
import uuid
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import xxhash

_arrays_hash64: Callable[[Any], int] = xxhash.xxh3_64_intdigest


def array_hash(value: Any, seen: dict[str, dict[int, int]]) -> int:
    """Return the hash of an array's data; equal numbers hash equally, -0.0 and NaN included.

    It works in blocks. ``seen`` maps, by type, the plain hash of a block to its canonical one, so
    unchanged data is read once.
    """
    data = np.ascontiguousarray(value)
    dtype = data.dtype
    if dtype.kind not in "fc" or not data.size:
        return _arrays_hash64(data.view(np.uint8) if dtype.kind in "UMm" and data.size else data)
    parts = data.reshape(-1)
    if dtype.kind == "c":
        parts = parts.view(data.real.dtype)
    size = parts.itemsize
    if size > 8:  # long doubles have padding, which is never set
        with np.errstate(all="ignore"):
            high = parts.astype(np.float64)
            low = np.where(np.isfinite(high), parts - high, 0).astype(np.float64)
        return _arrays_hash64(struct.pack("<2Q", array_hash(high, seen), array_hash(low, seen)))
    kind = parts.dtype.str
    known = seen.get(kind)
    if known is None or len(known) > _SEEN_MAX:
        known = seen[kind] = {}
    count = _BLOCK_BYTES // size
    digests = []
    for start in range(0, len(parts), count):
        block = parts[start : start + count]
        plain = _arrays_hash64(block)
        digest = known.get(plain)
        if digest is None:
            # As it is, a block nearly always is in its canonical form.
            digest = _canonical_hash(block) if _has_several_forms(block, kind) else plain
            known[plain] = digest
        digests.append(digest)
    return (
        digests[0]
        if len(digests) == 1
        else _arrays_hash64(struct.pack(f"<{len(digests)}Q", *digests))
    )


def _canonical_hash(block: Any) -> int:
    canonical = block.copy()
    canonical[canonical == 0.0] = 0.0
    canonical[np.isnan(canonical)] = np.nan
    return _arrays_hash64(canonical)


def _has_several_forms(parts: Any, kind: str) -> bool:
    """Return whether floats contain a -0.0 or a NaN: two quick checks, rarely true."""
    smallest = float(_smallest(parts))
    if smallest > 0.0:
        return False
    if smallest != smallest:
        return True
    integers, lowest = _INTEGERS[kind]
    return int(_smallest(parts.view(integers))) == lowest


_INTEGERS = {
    f"{order}f{size}": (np.dtype(f"{order}i{size}"), -(1 << (8 * size - 1)))
    for order in "<>"
    for size in (2, 4, 8)
}
"""Integers as wide as floats, and the smallest of them, which has the bits of -0.0."""

_smallest: Any = np.minimum.reduce
_BLOCK_BYTES = 256 << 10
_SEEN_MAX = 1 << 14


DEPTH_MAX = 200
"""Deeper values (a linked list of a million nodes) are left out and listed."""

_hash64: Callable[[Any], int] = xxhash.xxh3_64_intdigest
_pack_double = struct.Struct("<d").pack
_pack_count = struct.Struct("<Q").pack
_NAN = b"fN"
_identity: Callable[[object], int] = object.__hash__
"""Identifies objects like ``id``, but raises no audit event."""

_SKIPPED_MODULES = frozenset(
    "_thread _threading_local threading _io io socket ssl _socket select selectors asyncio "
    "multiprocessing subprocess concurrent rclpy rsltrace greenlet logging weakref ctypes _ctypes "
    "mmap".split()
)


class StateHasher:
    """Hashes values. ``skipped`` maps what was left out to its type."""

    def __init__(self) -> None:
        self.skipped: dict[str, str] = {}
        self.place = ""
        self._open: dict[int, int] = {}
        self._seen: dict[str, dict[int, int]] = {}
        self._out: list[bytes] = []

    def digest(self, value: object, place: str) -> int:
        """Return the hash of a value, never 0; ``place`` names it where something is left out."""
        write = _PLAIN.get(type(value))
        if write is not None:
            return _hash64(write(value)) or 1
        self.place = place
        out: list[bytes] = []
        self._out = out
        self._open.clear()
        self._add(value)
        return _hash64(b"".join(out)) or 1

    def _add(self, value: Any) -> None:
        kind = type(value)
        write = _PLAIN.get(kind)
        if write is not None:
            self._out.append(write(value))
            return
        opened, key = self._open, _identity(value)
        if key in opened:
            self._out.append(b"^%d;" % opened[key])
            return
        if len(opened) >= DEPTH_MAX:
            self._skip(value)
            return
        opened[key] = len(opened)
        try:
            handler = _HANDLERS.get(kind) or _handler_of(kind)
            handler(self, value)
        finally:
            del opened[key]

    def _skip(self, value: object) -> None:
        kind = type(value)
        if kind.__module__.partition(".")[0] != "rclpy":  # every node has those
            self.skipped.setdefault(self.place, f"{kind.__module__}.{kind.__qualname__}")
        self._out.append(b"?")

    # -- containers ------------------------------------------------------------------------------

    def _sequence(self, value: Any) -> None:
        out = self._out
        out.append(b"l" + _pack_count(len(value)))
        add, plain = self._add, _PLAIN.get
        for item in value:
            write = plain(type(item))
            if write is not None:
                out.append(write(item))
            else:
                add(item)

    def _mapping(self, value: Any) -> None:
        self._out.append(b"d" + _pack_count(len(value)))
        for key, item in value.items():
            self._add(key)
            self._add(item)

    def _set(self, value: Any) -> None:
        self._out.append(b"e" + _pack_count(len(value)))
        self._out += sorted(self._bytes_of(item) for item in value)

    def _bytes_of(self, value: object) -> bytes:
        saved, self._out = self._out, []
        self._add(value)
        own, self._out = self._out, saved
        return b"".join(own)

    def _array(self, value: Any) -> None:
        dtype = value.dtype
        self._out.append(f"a{dtype.str}{value.shape}".encode())
        if dtype.hasobject:
            self._sequence(value.ravel().tolist())
        elif dtype.names is not None:
            for name in dtype.names:
                self._array(value[name])
        else:
            self._out.append(_pack_count(array_hash(value, self._seen)))

    # -- objects ---------------------------------------------------------------------------------

    def _object(self, value: Any) -> None:
        kind = type(value)
        self._out.append(f"o{kind.__module__}.{kind.__qualname__};".encode())
        hook = getattr(value, "rsltrace_state", None)
        if callable(hook):
            self._add(hook())
            return
        if isinstance(value, dict):
            self._mapping(value)
        elif isinstance(value, (list, tuple, collections.deque)):
            self._sequence(value)
        elif isinstance(value, (set, frozenset)):
            self._set(value)
        for name, item in attributes_of(value).items():
            self._out.append(name.encode("utf-8", "surrogatepass") + b"=")
            self._add(item)

    def _reduced(self, value: Any) -> None:
        """Hash a value of a C type without attributes by what pickle would keep."""
        try:
            parts = value.__reduce_ex__(4)
        except Exception:
            self._skip(value)
            return
        kind = type(value)
        self._out.append(f"r{kind.__module__}.{kind.__qualname__};".encode())
        if isinstance(parts, tuple):
            self._sequence(parts[1:3])
            for extra in parts[3:5]:
                if extra is not None:
                    self._sequence(list(extra))
        else:
            self._add(parts)

    def _bound(self, value: Any) -> None:
        self._out.append(f"m{value.__func__.__qualname__};".encode())
        if _identity(value.__self__) not in self._open:
            self._add(value.__self__)

    def _partial(self, value: Any) -> None:
        self._sequence((value.func, value.args, value.keywords))

    def _random(self, value: Any) -> None:
        self._sequence(value.getstate())

    def _generator(self, value: Any) -> None:
        self._add(value.bit_generator.state)

    def _legacy_generator(self, value: Any) -> None:
        self._add(value.get_state(legacy=False))


def attributes_of(value: Any) -> dict[str, Any]:
    """Return an object's attributes by name, sorted: its ``__dict__`` and its slots."""
    kind = type(value)
    slots = _slots.get(kind)
    if slots is None:
        slots = _slots[kind] = _slots_of(kind)
    attributes = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    attributes.update(getattr(value, "__dict__", {}))
    return dict(sorted(attributes.items()))


_slots: dict[type, tuple[str, ...]] = {}


def _slots_of(kind: type) -> tuple[str, ...]:
    names = []
    for cls in kind.__mro__:
        slots = cls.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name.startswith("__") and not name.endswith("__"):
                name = f"_{cls.__name__.lstrip('_')}{name}"
            if name not in ("__dict__", "__weakref__"):
                names.append(name)
    return tuple(names)


def is_left_out(value: object) -> bool:
    """Return whether an object has no value: a lock, a generator, a handle."""
    kind = type(value)
    if kind in _PLAIN or hasattr(kind, "rsltrace_state"):
        return False
    return _is_left_out(kind)


def _is_left_out(kind: type) -> bool:
    # A subclass of a node or a thread is one, too.
    modules = {cls.__module__.partition(".")[0] for cls in kind.__mro__}
    return issubclass(kind, _SKIPPED_TYPES) or not _SKIPPED_MODULES.isdisjoint(modules)


def _float(value: float) -> bytes:
    return b"f" + _pack_double(value + 0.0) if value == value else _NAN


def _text(value: str) -> bytes:
    data = value.encode("utf-8", "surrogatepass")
    return b"s" + _pack_count(len(data)) + data


def _bytes(value: Any) -> bytes:
    return b"b" + _pack_count(len(value)) + bytes(value)


def _named(letter: bytes) -> Callable[[Any], bytes]:
    def write(value: Any) -> bytes:
        module = getattr(value, "__module__", "") or ""
        name = getattr(value, "__qualname__", None) or value.__name__
        return letter + f"{module}.{name};".encode()

    return write


_PLAIN: dict[type, Callable[[Any], bytes]] = {
    type(None): lambda value: b"n",
    bool: lambda value: b"T" if value else b"F",
    int: lambda value: b"i%d;" % value,
    float: _float,
    complex: lambda value: b"c" + _float(value.real) + _float(value.imag),
    str: _text,
    bytes: _bytes,
    bytearray: _bytes,
    memoryview: _bytes,
    range: lambda value: repr(value).encode(),
    type(...): lambda value: b".",
    types.FunctionType: _named(b"F"),
    types.BuiltinFunctionType: _named(b"B"),
    types.ModuleType: _named(b"M"),
    type: _named(b"C"),
    decimal.Decimal: lambda value: b"D" + repr(value).encode(),
    fractions.Fraction: lambda value: b"Q" + repr(value).encode(),
    datetime.datetime: lambda value: b"t" + repr(value).encode(),
    datetime.date: lambda value: b"t" + repr(value).encode(),
    datetime.time: lambda value: b"t" + repr(value).encode(),
    datetime.timedelta: lambda value: b"t" + repr(value).encode(),
    uuid.UUID: lambda value: b"u" + value.bytes,
}

UNCHANGING = frozenset(_PLAIN) - {bytearray, memoryview, type, types.FunctionType}
"""Types whose values, and so hashes, never change."""

_Handler = Callable[[StateHasher, Any], None]
_HANDLERS: dict[type, _Handler] = {
    list: StateHasher._sequence,
    tuple: StateHasher._sequence,
    dict: StateHasher._mapping,
    set: StateHasher._set,
    frozenset: StateHasher._set,
    types.MappingProxyType: StateHasher._mapping,
    types.MethodType: StateHasher._bound,
    functools.partial: StateHasher._partial,
    np.ndarray: StateHasher._array,
}
_SKIPPED_TYPES = (
    types.GeneratorType,
    types.CoroutineType,
    types.AsyncGeneratorType,
    types.FrameType,
    types.TracebackType,
    weakref.ReferenceType,
)


def _handler_of(kind: type) -> _Handler:
    """Choose how objects of a type are hashed, once."""
    handler = _choose(kind)
    _HANDLERS[kind] = handler
    return handler


def _choose(kind: type) -> _Handler:
    import random

    of_numpy = sys.modules.get("numpy.random")  # not loaded for nodes that have none
    if kind is getattr(of_numpy, "Generator", None):
        return StateHasher._generator
    if kind is getattr(of_numpy, "RandomState", None):
        return StateHasher._legacy_generator
    if hasattr(kind, "rsltrace_state"):
        return StateHasher._object
    if _is_left_out(kind):
        return StateHasher._skip
    if issubclass(kind, enum.Enum):
        return lambda hasher, value: hasher._out.append(
            f"E{type(value).__qualname__}.{value.name};".encode()
        )
    if issubclass(kind, type):
        return lambda hasher, value: hasher._out.append(_named(b"C")(value))
    if issubclass(kind, np.ndarray):
        return StateHasher._array
    if issubclass(kind, np.generic):
        return lambda hasher, value: hasher._array(np.asarray(value))
    if issubclass(kind, random.Random):
        return StateHasher._random
    if issubclass(kind, array.array):
        return lambda hasher, value: hasher._out.append(
            f"A{value.typecode}".encode() + _bytes(value.tobytes())
        )
    if issubclass(kind, pathlib.PurePath):
        return lambda hasher, value: hasher._out.append(b"p" + _text(str(value)))
    if issubclass(kind, tuple(_PLAIN)) and kind not in (type,):
        plain = next(cls for cls in kind.__mro__ if cls in _PLAIN)
        return lambda hasher, value: hasher._out.append(_PLAIN[plain](value))
    if kind.__dictoffset__ or any("__slots__" in cls.__dict__ for cls in kind.__mro__[:-1]):
        return StateHasher._object
    if issubclass(kind, (dict, list, tuple, set, frozenset, collections.deque)):
        return StateHasher._object
    return StateHasher._reduced
