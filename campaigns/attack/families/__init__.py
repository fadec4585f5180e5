"""The families of attacks, by name."""

from __future__ import annotations

import importlib

from campaigns.attack.families.common import Family

NAMES = (
    "traces",
    "records",
    "schemas",
    "texts",
    "pasted",
    "bags",
    "jobs",
    "nodes",
    "kills",
    "disks",
    "servers",
    "serving",
    "golden",
    "replays",
    "sources",
)


def family(name: str) -> Family:
    """Return a family. Each is the ``FAMILY`` of the module of its name."""
    found = importlib.import_module(f"campaigns.attack.families.{name}").FAMILY
    assert isinstance(found, Family)
    assert found.name == name
    return found


def families() -> dict[str, Family]:
    """Return all of them."""
    return {name: family(name) for name in NAMES}
