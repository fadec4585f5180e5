"""Whether the fields that an expression reads of a message are fields of its interface."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Mapping
from typing import NamedTuple

from rsltrace.conditions.names import Fields
from rsltrace.errors import did_you_mean

_INTERFACE = re.compile(r"\w+(?:/\w+){1,2}")


class WrongField(NamedTuple):
    """A part of an expression that names a field which is not there."""

    node: ast.AST
    message: str


def wrong_field(tree: ast.expr, interface: str, fields: Fields) -> WrongField | None:
    """Return the first part of ``tree`` that reads a field which an interface does not have."""
    own = {
        node.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            inner = _type_of(node.value, interface, fields, own)
            known = fields(inner) if inner else None
            if known is not None and node.attr not in known:
                hint = did_you_mean(node.attr, known, f"it has {', '.join(known)}")
                return WrongField(node, f"{inner} has no field {node.attr!r}; {hint}")
    return None


def _type_of(node: ast.AST, interface: str, fields: Fields, own: set[str]) -> str:
    """Return the interface that a part of an expression is one of, empty if nobody can say."""
    if isinstance(node, ast.Name):
        if node.id == "msg":
            return interface
        if node.id in own:
            return ""
        return _interface((fields(interface) or {}).get(node.id, ""))
    if isinstance(node, ast.Attribute):
        outer = _type_of(node.value, interface, fields, own)
        return _interface((fields(outer) or {}).get(node.attr, "")) if outer else ""
    return ""


def _interface(text: str) -> str:
    """Return the full name of an interface as fields name it; empty for a number or a list."""
    if not _INTERFACE.fullmatch(text):
        return ""
    package, *_, name = text.split("/")
    return f"{package}/msg/{name}" if text.count("/") == 1 else text


def loaded_fields(interface: str) -> Mapping[str, str] | None:
    """Return the fields of an interface (``nav_msgs/msg/Odometry``) whose class is loaded; to look
    at a run must not import anything into it."""
    package, _, name = interface.partition("/")
    kind, _, name = name.partition("/")
    found = getattr(sys.modules.get(f"{package}.{kind}"), name, None)
    known = getattr(found, "get_fields_and_field_types", None)
    return None if known is None else dict(known())
