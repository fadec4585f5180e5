"""Finds the definition files that rosidl installs beside the classes it generates.

``<prefix>/share/<package>/<kind>/<Name>.msg`` (or ``.srv``, ``.action``) is what the author wrote,
comments and all; ``<Name>.json`` is the type description whose hash ROS 2 compares.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

SEPARATOR = "---"
_SECTIONS = {
    "msg": {"": 0},
    "srv": {"Request": 0, "Response": 1},
    "action": {"Goal": 0, "Result": 1, "Feedback": 2},
}
"""Which section of its file holds a part. Parts not listed are made by rosidl, not the author."""


def installed_definition(name: str) -> str | None:
    """Return the text that defines a message or a part of a service or action, as installed.

    ``name`` is a full name such as ``std_srvs/srv/Trigger_Request``. None if no file defines it.
    """
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
    """Return the ``RIHS01_...`` hash of an interface by its full name, or None."""
    package, kind, type_ = name.split("/")
    path = _installed_file(package, kind, f"{type_.partition('_')[0]}.json")
    if path is None:
        return None
    try:
        hashes = json.loads(path.read_text("utf-8"))["type_hashes"]
        return next((str(h["hash_string"]) for h in hashes if h["type_name"] == name), None)
    except (ValueError, KeyError, TypeError):
        return None  # of a ROS version that describes types otherwise


def installed_description(name: str) -> Any:
    """Return the type description of an interface by its full name, as JSON has it, or None."""
    package, kind, type_ = name.split("/")
    path = _installed_file(package, kind, f"{type_}.json")
    return None if path is None else json.loads(path.read_text("utf-8"))


def installed_file_text(name: str) -> str | None:
    """Return the whole text of the file that an interface is defined in, or None."""
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
    # First the prefix that the class comes from: an overlay's definition may differ.
    spec = find_spec(package)
    for location in (spec.submodule_search_locations or []) if spec is not None else []:
        # <prefix>/lib/python3.12/site-packages/<package>, or one folder deeper
        yield from list(Path(location).parents)[2:5]
    for entry in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if entry:
            yield Path(entry)
    yield Path(sys.prefix)
