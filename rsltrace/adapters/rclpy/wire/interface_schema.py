"""The message definition a trace carries for each topic, so that it can be read without ROS.

It is what rosbag2 and the ``ros2msg`` encoding of MCAP call a concatenated definition: the text of
the message, then of every message in it, each after a line of 80 ``=`` and ``MSG: package/Type``.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from rsltrace.adapters.rclpy.wire.interface_classes import type_name
from rsltrace.adapters.rclpy.wire.interface_files import installed_definition, installed_type_hash
from rsltrace.adapters.rclpy.wire.message_spec import (
    Array,
    FieldType,
    Message,
    Primitive,
    Sequence,
    Text,
    message_spec,
)
from rsltrace.simulation.middleware.interface import MessageType, ServiceType

_RULE = "=" * 80
_FIELD = re.compile(r"\s*(?P<type>[^\s#]+)\s+(?P<name>[a-zA-Z]\w*)\s*(?P<constant>=)?", re.ASCII)
_TEXT_NAMES = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}


@cache
def schema_text(cls: type) -> str:
    """Return the concatenated ``ros2msg`` definition of a message class or part of a service.

    The definitions are those installed with the classes, or, where there is none (action wrappers,
    messages defined in IDL), made from the class: fields only, no comments or constants.

    Raises TypeError if rosidl did not generate the class.
    """
    root = message_spec(cls)
    pieces = [_definition(root)]
    for spec in _dependencies(root):
        pieces.append(f"{_RULE}\nMSG: {_short_name(spec)}\n{_definition(spec)}")
    return "".join(f"{piece}\n" if piece else "" for piece in pieces)


@cache
def type_hash(cls: type) -> str | None:
    """Return the type hash of an interface class (``RIHS01_`` and 64 hex digits).

    None if its type description is not installed. Raises TypeError if rosidl did not generate it.
    """
    return installed_type_hash(type_name(cls))


@cache
def message_type(cls: type) -> MessageType:
    """Return a message class as the middleware knows it: by name."""
    return MessageType(type_name(cls), lambda: (schema_text(cls), type_hash(cls) or ""))


@cache
def service_type(cls: Any) -> ServiceType:
    """Return a service class as the middleware knows it: by name."""
    request, response = message_type(cls.Request), message_type(cls.Response)
    return ServiceType(request.name.removesuffix("_Request"), request, response)


def _definition(spec: Message) -> str:
    text = installed_definition(spec.type_name)
    # A file of another version than the class would make every reader misread the messages.
    if text is not None and _field_names(text) == [field.name for field in spec.fields]:
        return text if "/msg/" in spec.type_name else _with_full_types(text, spec)
    return "\n".join(f"{_written(field.type)} {field.name}" for field in spec.fields)


def _with_full_types(text: str, spec: Message) -> str:
    """Write out the package of types that stand there without one.

    In a ``.srv`` or ``.action`` file these are messages of the same package, but readers that know
    of messages only take them for parts of the same service or action.
    """
    packages = {
        field.name: _short_name(item).rpartition("/")[0] + "/"
        for field in spec.fields
        if isinstance(item := getattr(field.type, "item", field.type), Message)
    }

    def full(line: str) -> str:
        match = _FIELD.match(line)
        if match is None or match["constant"] or "/" in match["type"]:
            return line
        start = match.start("type")
        return line[:start] + packages.get(match["name"], "") + line[start:]

    return "\n".join(map(full, text.splitlines()))


def _field_names(text: str) -> list[str]:
    matches = (_FIELD.match(line) for line in text.splitlines())
    return [match["name"] for match in matches if match and not match["constant"]]


def _dependencies(root: Message) -> list[Message]:
    """Return every message inside ``root`` once, in the order in which they are met."""
    found: dict[str, Message] = {}

    def visit(type_: FieldType) -> None:
        if isinstance(type_, Array | Sequence):
            visit(type_.item)
        elif isinstance(type_, Message) and type_.type_name not in found:
            found[type_.type_name] = type_
            for field in type_.fields:
                visit(field.type)

    for field in root.fields:
        visit(field.type)
    return list(found.values())


def _short_name(spec: Message) -> str:
    package, _, type_ = spec.type_name.split("/")
    return f"{package}/{type_}"


def _written(type_: FieldType) -> str:
    """Return a type as a ``.msg`` file has it."""
    if isinstance(type_, Primitive):
        return _TEXT_NAMES.get(type_.name, type_.name)
    if isinstance(type_, Text):
        bound = "" if type_.bound is None else f"<={type_.bound}"
        return f"{'wstring' if type_.wide else 'string'}{bound}"
    if isinstance(type_, Message):
        return _short_name(type_)
    if isinstance(type_, Array):
        return f"{_written(type_.item)}[{type_.length}]"
    bound = "" if type_.bound is None else f"<={type_.bound}"
    return f"{_written(type_.item)}[{bound}]"
