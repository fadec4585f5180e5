"""Interfaces by name, and their definitions and type hashes for traces.

Nothing of ROS is imported before it is needed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rsltrace.adapters.rclpy.messages.interface_classes import (
    class_of,
    get_message_class,
    get_service_class,
    type_name,
)
from rsltrace.adapters.rclpy.messages.message_spec import (
    ArrayType,
    FieldType,
    MessageSpec,
    PrimitiveType,
    SequenceType,
    StringType,
    message_spec,
)
from rsltrace.job.reading.substitute import installed_prefixes
from rsltrace.simulation.middleware.interface import MessageType, ServiceType

# rosidl installs ``<prefix>/share/<package>/<kind>/<Name>.msg`` (or ``.srv``, ``.action``), the
# author's text, and ``<Name>.json``, the type description whose hash ROS 2 compares.

SEPARATOR = "---"
_SECTIONS = {
    "msg": {"": 0},
    "srv": {"Request": 0, "Response": 1},
    "action": {"Goal": 0, "Result": 1, "Feedback": 2},
}
"""The section of the file that holds a part. Parts not listed are made by rosidl."""


def installed_definition(name: str) -> str | None:
    """Return the installed text that defines a message or a part of a service or action, or
    None."""
    package, kind, type_ = name.split("/")
    whole, _, part = type_.partition("_")
    index = _SECTIONS[kind].get(part)
    if index is None:
        return None
    path = _installed_file(package, kind, f"{whole}.{kind}")
    if path is None:
        return None
    sections: list[list[str]] = [[]]
    for line in path.read_text("utf-8", "replace").splitlines():
        if line.rstrip() == SEPARATOR:
            sections.append([])
        else:
            sections[-1].append(line.rstrip())
    return "\n".join(sections[index]).strip("\n") if index < len(sections) else None


def installed_type_hash(name: str) -> str | None:
    package, kind, type_ = name.split("/")
    path = _installed_file(package, kind, f"{type_.partition('_')[0]}.json")
    if path is None:
        return None
    try:
        hashes = json.loads(path.read_text("utf-8"))["type_hashes"]
        return next((str(h["hash_string"]) for h in hashes if h["type_name"] == name), None)
    except (ValueError, KeyError, TypeError):
        return None  # a ROS release with another format


def installed_description(name: str) -> Any:
    """Return the type description in the JSON file of an interface, which has its parts, too, as
    attributes, or None."""
    package, kind, type_ = name.split("/")
    path = _installed_file(package, kind, f"{type_.partition('_')[0]}.json")
    if path is None:
        return None
    return json.loads(path.read_text("utf-8"), object_hook=lambda item: SimpleNamespace(**item))


def installed_file_text(name: str) -> str | None:
    """Return the text of the file that defines an interface, or None."""
    package, kind, type_ = name.split("/")
    path = _installed_file(package, kind, f"{type_.partition('_')[0]}.{kind}")
    return None if path is None else path.read_text("utf-8", "replace")


def _installed_file(package: str, kind: str, file: str) -> Path | None:
    for prefix in _prefixes(package):
        path = prefix / "share" / package / kind / file
        if path.is_file():
            return path
    return None


def _prefixes(package: str) -> Iterator[Path]:
    # First the prefix of the class: an overlay's definition may differ.
    spec = find_spec(package)
    for location in (spec.submodule_search_locations or []) if spec is not None else []:
        # <prefix>/lib/python3.12/site-packages/<package>, or one folder deeper; of packages that
        # are not built: <prefix>/site-packages/<package>; of install-ros --into: <prefix>/<package>
        yield from list(Path(location).parents)[:5]
    yield from installed_prefixes()


# A trace holds the concatenated definition of each topic's type (``ros2msg`` of MCAP): the text of
# the message, then of every message in it, each after a line of 80 ``=`` and ``MSG: package/Type``.

_RULE = "=" * 80
_FIELD = re.compile(r"\s*(?P<type>[^\s#]+)\s+(?P<name>[a-zA-Z]\w*)\s*(?P<constant>=)?", re.ASCII)
_TEXT_NAMES = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}


@cache
def schema_text(cls: type) -> str:
    """Return the concatenated definition of a message class or part of a service.

    If no definition is installed (action wrappers, messages defined in IDL), it is made from the
    class, without comments and constants. Raises TypeError if rosidl did not generate the class.
    """
    root = message_spec(cls)
    pieces = [_definition(root)]
    for spec in _dependencies(root):
        pieces.append(f"{_RULE}\nMSG: {_short_name(spec)}\n{_definition(spec)}")
    return "".join(f"{piece}\n" if piece else "" for piece in pieces)


@cache
def type_hash(cls: type) -> str | None:
    """Return the type hash of an interface class (``RIHS01_`` and 64 hex digits), None if its
    description is not installed."""
    return installed_type_hash(type_name(cls))


@cache
def message_type(cls: type) -> MessageType:
    """Return the middleware's description of a message class."""
    return MessageType(type_name(cls), lambda: (schema_text(cls), type_hash(cls) or ""))


@cache
def service_type(cls: Any) -> ServiceType:
    """Return the middleware's description of a service class."""
    request, response = message_type(cls.Request), message_type(cls.Response)
    return ServiceType(request.name.removesuffix("_Request"), request, response)


def _definition(spec: MessageSpec) -> str:
    text = installed_definition(spec.type_name)
    # Do not use a file of another version than the class.
    if text is not None and _field_names(text) == [field.name for field in spec.fields]:
        return text if "/msg/" in spec.type_name else _with_full_types(text, spec)
    return "\n".join(f"{_written(field.type)} {field.name}" for field in spec.fields)


def _with_full_types(text: str, spec: MessageSpec) -> str:
    """Add the package to types without one.

    In a ``.srv`` or ``.action`` file these are messages of the same package, but readers would take
    them for parts of the same service or action.
    """
    packages = {
        field.name: _short_name(item).rpartition("/")[0] + "/"
        for field in spec.fields
        if isinstance(item := getattr(field.type, "item", field.type), MessageSpec)
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


def _dependencies(root: MessageSpec) -> list[MessageSpec]:
    """Return every message inside ``root`` once, in order of appearance."""
    found: dict[str, MessageSpec] = {}

    def visit(type_: FieldType) -> None:
        if isinstance(type_, ArrayType | SequenceType):
            visit(type_.item)
        elif isinstance(type_, MessageSpec) and type_.type_name not in found:
            found[type_.type_name] = type_
            for field in type_.fields:
                visit(field.type)

    for field in root.fields:
        visit(field.type)
    return list(found.values())


def _short_name(spec: MessageSpec) -> str:
    package, _, type_ = spec.type_name.split("/")
    return f"{package}/{type_}"


def _written(type_: FieldType) -> str:
    """Return a type in the syntax of ``.msg`` files."""
    if isinstance(type_, PrimitiveType):
        return _TEXT_NAMES.get(type_.name, type_.name)
    if isinstance(type_, StringType):
        bound = "" if type_.bound is None else f"<={type_.bound}"
        return f"{'wstring' if type_.wide else 'string'}{bound}"
    if isinstance(type_, MessageSpec):
        return _short_name(type_)
    if isinstance(type_, ArrayType):
        return f"{_written(type_.item)}[{type_.length}]"
    bound = "" if type_.bound is None else f"<={type_.bound}"
    return f"{_written(type_.item)}[{bound}]"


__all__ = [
    "class_of",
    "get_message_class",
    "get_service_class",
    "message_type",
    "schema_text",
    "service_type",
    "type_hash",
    "type_name",
]
