"""What a launch file can see while it is read: arguments, environment, namespace, defaults."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from typing import Any


@dataclass(frozen=True, slots=True)
class ParameterFile:
    """A file of parameters (absolute), at its place among a node's parameters."""

    path: str


Parameters = tuple["ParameterFile | dict[str, Any]", ...]
"""Files and mappings in order; what comes later has the last word."""


@dataclass(slots=True)
class Scope:
    """What one group can see; ``copy`` gives an inner group its own."""

    configurations: dict[str, str] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=lambda: dict(os.environ))
    namespace: str = ""
    parameters: Parameters = ()
    remappings: tuple[tuple[str, str], ...] = ()

    def copy(self) -> Scope:
        """Return a copy that can be changed without changing this."""
        return replace(
            self, configurations=dict(self.configurations), environment=dict(self.environment)
        )


def absolute_namespace(base: str, own: str | None) -> str | None:
    """Return the namespace of a node below another one; None if there is neither. An empty one
    is the root, if there is no other."""
    namespace = joined_namespace(base, own)
    if namespace and not namespace.startswith("/"):
        namespace = f"/{namespace}"
    return namespace or (None if own is None else "/")


def full_name(namespace: str | None, name: str) -> str:
    """Return the name of a node with its namespace; a name that is a path already stands alone."""
    return name if name.startswith("/") else f"{(namespace or '').rstrip('/')}/{name}"


def joined_namespace(base: str, own: str | None) -> str:
    """Return a namespace below another one, as launch joins them; absolute ones stand alone."""
    if own is None or own == "":
        return base
    if own.startswith("/"):
        return "/" + own.strip("/")
    return f"{base.rstrip('/')}/{own.strip('/')}"
