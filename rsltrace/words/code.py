"""The code of a callback on this machine: traces name files as they are imported."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from rsltrace.model.event import Event, EventKind
from rsltrace.trace.reader import Trace


def code_place(trace: Trace, event: Event) -> str:
    """Return ``module.py:24`` of the function that an event ran, or "": a constructor's for a node
    that was made in it."""
    entity = event.entity
    if event.kind is EventKind.CONSTRUCT:
        made = (output.entity for output in trace.outputs_of(event.index))
        entity = next((one for one in made if _is_node(trace, one)), entity)
    found = trace.entities.get(entity)
    return "" if found is None else found.source


def code_file(trace: Trace, place: str) -> tuple[Path, int] | None:
    """Return file and line (from 1) of a place, if a file of that name is where the job's are.

    Looked for below the present folder and that of the trace, in the folders of the job's
    ``search_path``. Nothing says that it is the file of then: see ``rsltrace:sources``.
    """
    name, _, line = place.rpartition(":")
    path = PurePosixPath(name)
    if not line.isdecimal() or path.is_absolute() or ".." in path.parts:
        return None
    for folder in _folders(trace):
        if (folder / path).is_file():
            return folder / path, int(line)
    return None


def _folders(trace: Trace) -> Iterator[Path]:
    bases = [Path()] if "://" in trace.name else [Path(), Path(trace.name).parent]
    try:
        listed = json.loads(trace.job.get("resolved") or "{}").get("search_path")
    except (ValueError, AttributeError, RecursionError):
        listed = None
    for base in bases:
        for folder in listed if isinstance(listed, list) else ():
            if isinstance(folder, str) and "\0" not in folder:
                yield base / folder
        yield base


def _is_node(trace: Trace, entity: int) -> bool:
    found = trace.entities.get(entity)
    return found is not None and found.node == found.id != 0
