"""ROS parameter files as far as launching needs to look into them itself."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rsltrace.adapters.launch.model import yaml_value
from rsltrace.errors import JobError
from rsltrace.trace.model.regular_file import read_regular

_KEY = "ros__parameters"


def substituted_parameters(
    path: str, replaced: Callable[[str], str], full_name: str | None
) -> dict[str, Any]:
    """Return the parameters for a node in a file that has substitutions in it."""
    return matching(replaced(_read(path)), path, full_name)


def parameters_for(path: str, full_name: str | None) -> dict[str, Any]:
    """Return the parameters a file gives a node, flat; without a name, those for all nodes."""
    return matching(_read(path), path, full_name)


def _read(path: str) -> str:
    try:
        return read_regular(Path(path)).decode()
    except OSError as error:
        raise JobError(f"cannot read the parameter file: {error.strerror}", where=path) from None
    except UnicodeDecodeError:
        raise JobError("the parameter file is not UTF-8 text", where=path) from None


def matching(text: str, path: str, full_name: str | None) -> dict[str, Any]:
    """Return the parameters for a node in the text of a file, by rcl's rules for wildcards."""
    content = yaml_value(text)
    if not isinstance(content, dict):
        raise JobError("this is not a parameter file (node: {ros__parameters: …})", where=path)
    values: dict[str, Any] = {}
    for name, parameters in _sections(content, ""):
        pattern = f"/{name.lstrip('/')}".replace("/*", r"(/\w+)")
        if name == "/**" or (full_name is not None and re.fullmatch(pattern, full_name)):
            values.update(flat(parameters))
    return values


def flat(values: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield parameters with dotted names."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _sections(content: dict[str, Any], prefix: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, inner in content.items():
        if not isinstance(inner, dict):
            continue
        full = f"{prefix}/{str(name).strip('/')}" if prefix else str(name)
        if isinstance(inner.get(_KEY), dict):
            yield full, inner[_KEY]
        yield from _sections({k: v for k, v in inner.items() if k != _KEY}, full)
