"""Decode messages of a trace into objects, by the schemas in the trace itself.

rosbags generates a Python decoder per type from schema text. A trace may come from anybody, so its
schemas are checked first: only the parsed structure is used, every name is a plain identifier, and
sizes and nesting are limited. Constants are not needed for decoding; integer ones are kept beside
the classes, for display. Opening a trace runs none of this.
"""

from __future__ import annotations

import dataclasses
import math
import re
import struct
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.serde.cdr import generate_deserialize_cdr
from rosbags.typesys.base import TypesysError, normalize_fieldname
from rosbags.typesys.msg import get_types_from_msg, normalize_msgtype
from rosbags.typesys.store import Typestore

from rsltrace.errors import TraceError
from rsltrace.trace.cdr import WIDE_TEXT_TYPE, replace_wide_texts, restore_wide_texts
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.mcap import records as limits
from rsltrace.trace.mcap.records import SCHEMA_ENCODING
from rsltrace.trace.model.texts import NO_FIELD, PLACEHOLDERS

_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*){1,3}", re.ASCII)
_CONSTANT_NAME = re.compile(r"[A-Z][A-Z0-9_]*", re.ASCII)
_CONSTANTS_MAX = 1000
_FIELD_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_INTEGER_TYPES = {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
_BASE_TYPES = _INTEGER_TYPES | {"bool", "byte", "char", "float32", "float64", "string"}
_NESTING_MAX = 32
_ARRAY_ITEMS_MAX = 1 << 32


_DECODING_ERRORS = (SerdeError, struct.error, AssertionError, IndexError, ValueError, MemoryError)
"""Errors of rosbags' decoders, some only of older versions, for data that does not fit."""


class Decoder:
    """Decodes the messages of one channel's schema: type ``name``, defined in ``types``.

    ``wide_texts``: the schema has some, which ``types`` define as messages.
    """

    def __init__(self, channel: ChannelInfo) -> None:
        """Check the schema and make the decoder. Raises TraceError if the schema is unusable."""
        self._channel = channel
        if channel.schema_encoding != SCHEMA_ENCODING:
            raise self._unusable(f"its encoding is {channel.schema_encoding!r}")
        if len(channel.schema_text) > limits.SCHEMA_BYTES_MAX:
            raise self._unusable(f"it is longer than {limits.SCHEMA_BYTES_MAX} characters")
        if not _TYPE_NAME.fullmatch(channel.type):
            raise self._unusable(f"{channel.type!r} is no name of a type")
        # Types without a package are in the package of the type; those that a service names are in
        # the package's msg folder.
        self.name = normalize_msgtype(channel.type.replace("/srv/", "/msg/", 1))
        schema = replace_wide_texts(channel.schema_text)
        self.wide_texts = schema is not channel.schema_text
        try:
            types = get_types_from_msg(schema, self.name)
            self.types: dict[str, Any] = {
                name: ([], _checked_fields(name, types)) for name in types
            }
            self.items = sum(map(_unrolled_items, self.types.values()))
            if self.items > limits.SCHEMA_ITEMS_MAX:
                raise _UnsafeSchema(f"its fixed arrays have {self.items} strings or messages")
            depths: dict[str, int] = {}
            for name in types:
                _nesting(name, types, depths)
            # A store per schema: two channels may define one type differently.
            self._store = _DecodingStore()
            self._store.register(self.types)
            self._store.get_msgdef(self.name)
            for name in types:  # once the classes are made, which would have them as fields
                made = self._store.types[name].__init__.__globals__["FIELDDEFS"]
                made[name][0].extend(_constants(types[name]))
        except (TypesysError, _UnsafeSchema, RecursionError, KeyError, ValueError) as error:
            raise self._unusable(error) from error

    def decode(self, data: bytes) -> object:
        """Return the message, an instance of a class made for its type. Raises TraceError.

        Arrays of numbers are numpy arrays; fields are attributes by their ROS names (with an
        underscore behind Python's keywords).
        """
        try:
            message = self._store.deserialize_cdr(data, self.name)
            return restore_wide_texts(message) if self.wide_texts else message
        except _DECODING_ERRORS as error:
            raise TraceError(
                f"a message on {self._channel.topic} does not fit its type {self._channel.type}: "
                f"{error}"
            ) from error

    def fields_of(self, interface: str) -> dict[str, str] | None:
        """Return the fields of a type with their message types (others: empty), None if unknown."""
        found = self.types.get(interface)
        if found is None:
            return None
        return {
            name: str(detail) if kind == Nodetype.NAME and detail != WIDE_TEXT_TYPE else ""
            for name, (kind, detail) in found[1]
            if name not in PLACEHOLDERS
        }

    def leaves(self) -> list[ValueField]:
        """Return the fields of the message that hold values."""

        return leaves_of(self.name, self.types)

    def of(self, channel: ChannelInfo) -> Decoder:
        """Return this decoder for another channel of the same schema."""
        other = copy(self)
        other._channel = channel
        return other

    def _unusable(self, why: object) -> TraceError:
        first_line = (str(why).splitlines() or [type(why).__name__])[0]
        return TraceError(
            f"messages on {self._channel.topic} cannot be decoded: the trace's schema of "
            f"{self._channel.type or 'their type'} is not usable ({first_line})"
        )


class _DecodingStore(Typestore):  # type: ignore[misc]  # it has no types
    """Makes what decodes a type: one of the twelve functions that rosbags would compile."""

    def get_msgdef(self, typename: str) -> _MessageType:
        """Return what decodes a type, made when it is first asked for."""
        found: _MessageType | None = self.cache.get(typename)
        if found is None:
            found = self.cache[typename] = _MessageType(self, typename)
        return found


class _MessageType:
    """As much of rosbags' ``Msgdef`` as decoding needs."""

    def __init__(self, store: _DecodingStore, name: str) -> None:
        self.cls = store.types[name]
        described = store.fielddefs[name][1]
        self.fields = [(normalize_fieldname(field), detail) for field, detail in described]
        self._store = store
        self.deserialize_cdr_le = generate_deserialize_cdr(self.fields, store, "le")

    @cached_property
    def deserialize_cdr_be(self) -> Any:
        """Decodes data of a machine with the other order of bytes, which is rare."""
        return generate_deserialize_cdr(self.fields, self._store, "be")


class Decoders:
    """The decoders of a trace: one per schema, within limits for all schemas."""

    def __init__(self) -> None:
        self._by_channel: dict[int, Decoder] = {}
        self._by_schema: dict[tuple[str, str, str], Decoder] = {}
        self._bytes = 0
        self._items = 0

    def of(self, channel: ChannelInfo) -> Decoder:
        """Return the decoder of a channel. Raises TraceError if its schema is unusable."""
        decoder = self._by_channel.get(channel.id)
        if decoder is None:
            key = (channel.type, channel.schema_encoding, channel.schema_text)
            made = self._by_schema.get(key) or self._make(channel)
            self._by_schema[key] = made
            decoder = self._by_channel[channel.id] = made.of(channel)
        return decoder

    def _make(self, channel: ChannelInfo) -> Decoder:
        self._bytes += len(channel.schema_text)
        if self._bytes > limits.SCHEMAS_BYTES_MAX or self._items > limits.SCHEMAS_ITEMS_MAX:
            raise TraceError(
                f"messages on {channel.topic} cannot be decoded: the schemas of this trace are "
                "larger than those of any robot"
            )
        made = Decoder(channel)
        self._items += made.items
        return made


def to_plain(value: object) -> Any:
    """Return a decoded message for ``json``: dicts, lists, numbers, strings.

    JSON has no NaN or infinity; they become the strings ``NaN``, ``Infinity``, ``-Infinity``.
    """
    kind: Any = type(value)
    if kind in _PLAIN:
        return value
    names = field_names(kind)
    if names is not None:
        return {name: to_plain(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        values = value.tolist()
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            return [to_plain(item) for item in values]
        return values
    if isinstance(value, list):
        return [to_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


_PLAIN = (int, str, bool, type(None))


@lru_cache(maxsize=4096)
def field_names(kind: Any) -> tuple[str, ...] | None:
    """Return the field names of a decoded message class; None for other classes."""
    if not dataclasses.is_dataclass(kind):
        return None
    names = (field.name for field in dataclasses.fields(kind))
    return tuple(name for name in names if name not in PLACEHOLDERS)


class _UnsafeSchema(ValueError):
    """The schema contains something that no ROS interface contains."""


def _constants(definition: Any) -> list[tuple[str, str, int]]:
    """Return the integer constants of a message definition."""
    constants, fields = definition
    taken = {name for name, _ in fields}
    found = {
        name: (name, kind, value)
        for name, kind, value in constants
        if kind in _INTEGER_TYPES | {"byte", "char"}
        and type(value) is int
        and name not in taken
        and _CONSTANT_NAME.fullmatch(name)
    }
    return list(found.values())[:_CONSTANTS_MAX]


def _checked_fields(name: str, types: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return the fields of type ``name`` after checking everything that becomes code."""
    if not _TYPE_NAME.fullmatch(name):
        raise _UnsafeSchema(f"{name!r} is no name of a type")
    fields: list[tuple[str, Any]] = types[name][1]
    names = [field_name.rstrip("_") for field_name, _ in fields]
    if len(set(names)) < len(names):
        raise _UnsafeSchema(f"{name!r} has two fields of one name")
    for field_name, description in fields:
        if not _FIELD_NAME.fullmatch(field_name):
            raise _UnsafeSchema(f"{field_name!r} is no name of a field")
        _check_type(description, types)
    return fields


def _unrolled_items(definition: tuple[list[Any], list[tuple[str, Any]]]) -> int:
    """Return the number of items for which code is generated: those of fixed arrays."""
    arrays = [detail for _, (kind, detail) in definition[1] if kind == Nodetype.ARRAY]
    return sum(n for item, n in arrays if item[0] == Nodetype.NAME or item[1][0] == "string")


def _check_type(description: Any, types: dict[str, Any]) -> None:
    kind, detail = description
    if kind == Nodetype.BASE:
        base, limit = detail
        if base not in _BASE_TYPES or not isinstance(limit, int):
            raise _UnsafeSchema(f"there is no type {base!r}")
    elif kind == Nodetype.NAME:
        if detail not in types:
            raise _UnsafeSchema(f"it does not define {detail!r}")
    elif kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        item, size = detail
        if item[0] not in (Nodetype.BASE, Nodetype.NAME):
            raise _UnsafeSchema("it has an array of arrays")
        _check_type(item, types)
        # Arrays of empty fixed arrays could count forever without using data.
        smallest = 1 if kind == Nodetype.ARRAY else 0
        if not isinstance(size, int) or not smallest <= size <= _ARRAY_ITEMS_MAX:
            raise _UnsafeSchema(f"an array cannot have {size} items")
    else:
        raise _UnsafeSchema(f"there is no kind of field {kind!r}")


def _nesting(name: str, types: dict[str, Any], known: dict[str, int]) -> int:
    """Return how deeply type ``name`` nests others; ``known`` caches results."""
    if name not in known:
        known[name] = _NESTING_MAX  # what a type that contains itself finds
        inner = [0]
        for _, (kind, detail) in types[name][1]:
            item = detail[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, detail)
            if item[0] == Nodetype.NAME:
                inner.append(1 + _nesting(item[1], types, known))
        if max(inner) >= _NESTING_MAX:
            raise _UnsafeSchema(f"{name!r} contains itself or is nested too deeply")
        known[name] = max(inner)
    return known[name]


# The fields of a type that hold values, at any depth.

_DEPTH_MAX = 6


@dataclass(frozen=True, slots=True)
class ValueField:
    """A field by its name, with ``[]`` behind each array, and the type of one value (``float32``,
    ``string``; "" for messages).

    With ``length_max`` it is an array itself, with at most that many items.
    """

    name: str
    type: str
    length_max: int | None = None


def leaves_of(name: str, types: dict[str, Any]) -> list[ValueField]:
    """Return the value fields of a type, which is defined in ``types``."""
    return list(_leaves(name, types, "", _DEPTH_MAX))


def _leaves(of: str, types: dict[str, Any], prefix: str, depth: int) -> Iterator[ValueField]:
    for field, description in types[of][1]:
        name, (kind, detail) = f"{prefix}{field}", description
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (inner, inner_detail), size = detail
            if kind == Nodetype.SEQUENCE:
                base = inner_detail[0] if inner == Nodetype.BASE else ""
                yield ValueField(name, base, size or 1 << 20)
            name, kind, detail = f"{name}[]", inner, inner_detail
        if kind == Nodetype.BASE:
            if field != NO_FIELD:
                yield ValueField(name, detail[0])
        elif detail == WIDE_TEXT_TYPE:
            yield ValueField(name, "string")
        elif depth > 1:
            yield from _leaves(detail, types, f"{name}.", depth - 1)
