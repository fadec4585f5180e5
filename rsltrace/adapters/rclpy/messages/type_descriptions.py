"""Descriptions of interfaces for ``~/get_type_description``.

rosidl compiles them into the type support libraries; they are read through the same pointers that
rcl follows. Those of interfaces that are not built are in a file.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from ctypes import (
    CFUNCTYPE,
    POINTER,
    Structure,
    c_char_p,
    c_size_t,
    c_uint8,
    c_uint64,
    c_void_p,
    string_at,
)
from dataclasses import dataclass
from functools import cache
from typing import Any

from rsltrace.adapters.rclpy.messages.interface_classes import type_name
from rsltrace.adapters.rclpy.messages.interfaces import installed_description, installed_file_text

_get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_get_pointer.restype, _get_pointer.argtypes = c_void_p, (ctypes.py_object, c_char_p)
_get_name = ctypes.pythonapi.PyCapsule_GetName
_get_name.restype, _get_name.argtypes = c_char_p, (ctypes.py_object,)


class _Hash(Structure):
    _fields_ = (("version", c_uint8), ("value", c_uint8 * 32))


class _String(Structure):
    _fields_ = (("data", c_void_p), ("size", c_size_t), ("capacity", c_size_t))


def _sequence_of(item: type[Structure]) -> type[Structure]:
    fields = (("data", POINTER(item)), ("size", c_size_t), ("capacity", c_size_t))
    return type(f"_Sequence{item.__name__}", (Structure,), {"_fields_": fields})


class _Source(Structure):
    _fields_ = (("type_name", _String), ("encoding", _String), ("contents", _String))


class _FieldType(Structure):
    _fields_ = (
        ("type_id", c_uint8),
        ("capacity", c_uint64),
        ("string_capacity", c_uint64),
        ("nested_type_name", _String),
    )


class _Field(Structure):
    _fields_ = (("name", _String), ("type", _FieldType), ("default_value", _String))


class _Type(Structure):
    _fields_ = (("type_name", _String), ("fields", _sequence_of(_Field)))


class _Description(Structure):
    _fields_ = (("described", _Type), ("referenced", _sequence_of(_Type)))


_GET_HASH = CFUNCTYPE(POINTER(_Hash), c_void_p)
_GET_DESCRIPTION = CFUNCTYPE(POINTER(_Description), c_void_p)
_GET_SOURCES = CFUNCTYPE(POINTER(_sequence_of(_Source)), c_void_p)

# The number of pointers before the three functions in rosidl's type support structures.
_BEFORE = {"message": 3, "service": 8, "action": 5}


@dataclass(frozen=True)
class TypeDescription:
    """The description of an interface: the types it is made of (itself first), each with the
    (name, type id, capacity, string capacity, nested type, default) of its fields, and the
    (type name, encoding, text) of its sources."""

    type_hash: str
    types: tuple[tuple[str, tuple[tuple[str, int, int, int, str, str], ...]], ...]
    sources: tuple[tuple[str, str, str], ...]

    def message(self) -> Any:
        """Return it as ``type_description_interfaces/msg/TypeDescription``."""
        from type_description_interfaces.msg import TypeDescription as Message

        first, *others = (_type_message(name, fields) for name, fields in self.types)
        return Message(type_description=first, referenced_type_descriptions=others)


def _type_message(name: str, fields: tuple[Any, ...]) -> Any:
    from type_description_interfaces.msg import Field, FieldType, IndividualTypeDescription

    return IndividualTypeDescription(
        type_name=name,
        fields=[
            Field(
                name=field,
                type=FieldType(
                    type_id=number,
                    capacity=capacity,
                    string_capacity=string_capacity,
                    nested_type_name=nested,
                ),
                default_value=default,
            )
            for field, number, capacity, string_capacity, nested, default in fields
        ],
    )


def _pointer(capsule: Any) -> int:
    return int(_get_pointer(capsule, _get_name(capsule)))


@cache
def type_description(interface: Any) -> TypeDescription | None:
    """Describe a message, service or action class; None if its type support has no description."""
    metaclass = type(interface)
    if metaclass._TYPE_SUPPORT is None:
        metaclass.__import_type_support__()
    if metaclass._TYPE_SUPPORT is None:
        return None
    if type(metaclass._TYPE_SUPPORT).__name__ != "PyCapsule":
        return _from_file(type_name(interface))
    if hasattr(interface, "Goal"):
        kind = "action"
    else:
        kind = "service" if hasattr(interface, "Request") else "message"
    support = _pointer(metaclass._TYPE_SUPPORT)
    pointers = ctypes.cast(support, POINTER(c_void_p))
    first = _BEFORE[kind]
    functions = [pointers[first + index] for index in range(3)]
    if not all(functions):
        return None
    digest = _GET_HASH(functions[0])(support).contents
    description = _GET_DESCRIPTION(functions[1])(support).contents
    sources = _GET_SOURCES(functions[2])(support).contents
    return TypeDescription(
        type_hash=f"RIHS{digest.version:02d}_{bytes(digest.value).hex()}",
        types=tuple(map(_type, [description.described, *_items(description.referenced)])),
        sources=tuple(
            (_text(source.type_name), _text(source.encoding), _text(source.contents))
            for source in _items(sources)
        ),
    )


def _from_file(name: str) -> TypeDescription | None:
    """Read rosidl's description of an interface whose type support is not compiled."""
    read = installed_description(name)
    if read is None:
        return None
    whole, text = read.type_description_msg, installed_file_text(name)
    return TypeDescription(
        type_hash=next(h.hash_string for h in read.type_hashes if h.type_name == name),
        types=tuple(map(_type, [whole.type_description, *whole.referenced_type_descriptions])),
        sources=() if text is None else ((name, name.split("/")[1], text),),
    )


def _type(described: Any) -> tuple[str, tuple[tuple[str, int, int, int, str, str], ...]]:
    return _text(described.type_name), tuple(
        (
            _text(field.name),
            field.type.type_id,
            field.type.capacity,
            field.type.string_capacity,
            _text(field.type.nested_type_name),
            _text(field.default_value),
        )
        for field in _items(described.fields)
    )


def _items(sequence: Any) -> list[Any]:
    if isinstance(sequence, list):  # from a file
        return sequence
    return [sequence.data[index] for index in range(sequence.size)]


def _text(string: Any) -> str:
    if isinstance(string, str):  # from a file
        return string
    return string_at(string.data, string.size).decode() if string.data else ""


def answer_request(request: Any, response_type: Any, interfaces: Iterable[Any]) -> Any:
    """Answer a GetTypeDescription request about a node's interfaces, as rcl does."""
    from type_description_interfaces.msg import TypeSource

    wanted = str(request.type_hash)
    if not wanted.startswith("RIHS") or len(wanted) != 71:
        return response_type(failure_reason="Failed to parse type hash")
    for interface in interfaces:
        found = type_description(interface)
        if found is not None and found.type_hash == wanted:
            response = response_type(successful=True, type_description=found.message())
            if request.include_type_sources:
                response.type_sources = [
                    TypeSource(type_name=name, encoding=encoding, raw_file_contents=text)
                    for name, encoding, text in found.sources
                ]
            return response
    return response_type(failure_reason="Type not currently in use by this node")
