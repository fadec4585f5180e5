"""The source code of callbacks and outputs on this machine: traces have module file names."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import (
    NO_SEQUENCE,
    CodeLine,
    EventKind,
    EventRecord,
    Output,
    OutputKind,
    is_switch,
)
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.logs import log_record

ELSEWHERE = "elsewhere"
"""Listed with an output's possible lines: its own line was not noted."""
_SENT = frozenset((OutputKind.MESSAGE, OutputKind.REQUEST))
_LATER = frozenset((EventKind.TASK, EventKind.RESUME, EventKind.CLIENT, EventKind.ACTION))
"""Kinds of events that may run another function than their entity's callback."""
_PLACES_SHOWN = 3
_LINE_DIGITS = 9


def code_place(trace: Trace, event: EventRecord) -> str:
    """Return the only entry of ``code_places``, "" for none or several."""
    places = code_places(trace, event)
    return places[0] if len(places) == 1 else ""


def code_places(trace: Trace, event: EventRecord) -> list[str]:
    """Return ``module.py:24`` of the function that an event ran: the constructor of a new node, the
    call of an awaited response.

    Several if the entity ran several and it is unknown which; none if unknown.
    """
    entity = event.entity
    if event.kind is EventKind.CONSTRUCT:
        made = (output.entity for output in trace.outputs_of(event.index))
        entity = next((one for one in made if _is_node(trace, one)), entity)
    found = trace.entities.get(entity)
    source = "" if found is None else found.source
    if event.kind in _LATER and not (source and event.kind is EventKind.ACTION):
        places = _functions(trace.code_lines.get(entity, []), event)
        if places:
            return places
    return [source] if source else []


def _functions(lines: list[CodeLine], event: EventRecord) -> list[str]:
    met = [line for line in lines if line.event <= event.index and line.place]
    of_call = [line for line in met if event.kind is EventKind.CLIENT]
    best = [line for line in met if line.output == NO_SEQUENCE] or of_call
    now = [line for line in best if line.event == event.index]
    return list(dict.fromkeys(line.place for line in now or best))


def output_places(trace: Trace, output: Output) -> list[str]:
    """Return the lines (``module.py:31``) that a message, call or log record came from, or before
    which another thread continued.

    Several if the callback had sent from several until then; none if unknown. The last is
    ``ELSEWHERE`` if the output's line was not noted.
    """
    if output.kind is OutputKind.LOG:
        record = log_record(trace, output)
        return [record.place] if record is not None and record.place else []
    if output.kind is OutputKind.DRAW and is_switch(output.hash):
        place = trace.switches.get(output.event)
        return [place] if place else []
    if output.kind not in _SENT:
        return []
    running = trace.event(output.event).entity
    lines = trace.output_lines.get((output.entity, running), [])
    number = NO_SEQUENCE
    if any(line.event == output.event for line in lines):
        rows = next(trace.outputs(output.event, output.event + 1))
        fields = ("entity", "kind", "hash", "sequence")
        same = [rows[name] == getattr(output, name) for name in fields]
        numbers = np.flatnonzero(np.logical_and.reduce(same)).tolist()
        exact = [line for line in lines if line.event == output.event and line.output in numbers]
        if len(numbers) == 1 and exact and exact[0].place:
            return [exact[0].place]
        number = numbers[-1] if numbers else number
    met = [line.place for line in lines if (line.event, line.output) < (output.event, number)]
    places = list(dict.fromkeys(filter(None, met)))
    return [*places, ELSEWHERE] if places and "" in met else places


def entity_places(trace: Trace, entity: Entity) -> list[str]:
    """Return the functions that an entity runs, then the lines from which it sends."""
    lines = trace.code_lines.get(entity.id, [])
    ran = [line.place for line in lines if line.output == NO_SEQUENCE]
    sent = [line.place for line in lines if line.output != NO_SEQUENCE]
    return list(dict.fromkeys(filter(None, [entity.source, *ran, *sent])))


def places_text(places: list[str], joint: str = " or ") -> str:
    """Return places as one text, shortened: ``a.py:3 or a.py:9``."""
    more = len(places) - _PLACES_SHOWN
    shown = places[:_PLACES_SHOWN] + ([f"{more} more"] if more > 0 else [])
    return joint.join(shown)


def relative_place(trace: Trace, place: str) -> str:
    """Return a place relative to the working directory if it is below, else unchanged."""
    found = code_file(trace, place)
    if found is None or found[0].is_absolute() or ".." in found[0].parts:
        return place
    return f"{found[0].as_posix()}:{found[1]}"


def code_file(trace: Trace, place: str) -> tuple[Path, int] | None:
    """Return file and line (from 1) of a place, if such a file is found.

    Searched below the working directory and the trace's folder, in the job's ``search_path``. It
    may differ from the recorded file: see ``rsltrace:sources``.
    """
    name, _, line = place.rpartition(":")
    path = PurePosixPath(name)
    if not line.isdecimal() or len(line) > _LINE_DIGITS or path.is_absolute() or ".." in path.parts:
        return None
    for folder in _folders(trace):
        if os.path.isfile(folder / path):  # False of a name that no file can have, too
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
