"""Descriptions of interfaces for ``~/get_type_description``.

rosidl compiles them into the type support libraries, where rcl finds them, and installs them as
files, which are read here.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from rsltrace.adapters.rclpy.messages.interface_classes import type_name
from rsltrace.adapters.rclpy.messages.interfaces import installed_description, installed_file_text
from rsltrace.fast_dataclass import dataclass


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


@cache
def type_description(interface: Any) -> TypeDescription | None:
    """Describe a message, service or action class; None if no description is installed."""
    name = type_name(interface)
    read = installed_description(name)
    if read is None:
        return None
    whole = read.type_description_msg
    types = {t.type_name: t for t in [whole.type_description, *whole.referenced_type_descriptions]}
    if name not in types:
        return None
    needed, found = {name}, [name]
    for each in found:  # grows
        for field in types[each].fields:
            nested = field.type.nested_type_name
            if nested and nested not in needed:
                needed.add(nested)
                found.append(nested)
    names = [name, *sorted(needed - {name})]
    return TypeDescription(
        type_hash=next(h.hash_string for h in read.type_hashes if h.type_name == name),
        types=tuple((each, tuple(map(_field, types[each].fields))) for each in names),
        sources=tuple(map(_source, names)),
    )


def _field(field: Any) -> tuple[str, int, int, int, str, str]:
    return (
        field.name,
        field.type.type_id,
        field.type.capacity,
        field.type.string_capacity,
        field.type.nested_type_name,
        field.default_value,
    )


def _source(name: str) -> tuple[str, str, str]:
    _, kind, type_ = name.split("/")
    if "_" in type_:  # a part of a service or an action
        return name, "implicit", ""
    text = installed_file_text(name) or ""
    # rosidl compiles a text with a NUL in place of its last character.
    return name, kind, f"{text[:-1]}\0" if text.endswith("\n") else text


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
