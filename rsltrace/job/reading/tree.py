"""The values of job files as a tree in which every value knows the file and line it came from.

A job may be put together from several files and from the command line; whatever is found wrong
with the result must be shown where it was written.
"""

from __future__ import annotations

import os

from rsltrace.job.reading.yaml_source import Item, Place
from rsltrace.job.values.paths import FileText
from rsltrace.job.values.problem import Loc


def item_at(root: Item, loc: Loc) -> tuple[Item, int]:
    """Return the item at ``loc`` or the nearest one around it, and how many steps it is away."""
    item = root
    for depth, part in enumerate(loc):
        inner = _child(item, part)
        if inner is None:
            return item, len(loc) - depth
        item = inner
    return item, 0


def place_at(root: Item, loc: Loc, *, at_key: bool = False) -> Place:
    """Return where the value (or the key) at ``loc`` stands, or the nearest value around it."""
    item, missing = item_at(root, loc)
    if at_key and not missing and item.key_place is not None:
        return item.key_place
    return item.place


def plain(item: Item, base_dir: str) -> object:
    """Return the values alone; text from other folders than ``base_dir`` remembers its own."""
    value = item.value
    if isinstance(value, dict):
        return {key: plain(inner, base_dir) for key, inner in value.items()}
    if isinstance(value, list):
        return [plain(inner, base_dir) for inner in value]
    if isinstance(value, str):
        folder = item.place.source.folder
        if folder is not None and folder != base_dir:
            return FileText(value, os.path.relpath(folder, base_dir))
    return value


def _child(item: Item, part: str | int) -> Item | None:
    value = item.value
    if isinstance(value, list):
        found = value[part : part + 1] if isinstance(part, int) and part >= 0 else []
    elif isinstance(value, dict):
        found = [inner for key, inner in value.items() if key == part or str(key) == part]
    else:
        found = []
    return found[0] if found else None
