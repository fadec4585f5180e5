"""Which nodes each entry of ``nodes:`` made, and whose code they may run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace

_EVENTS_MAX = 10_000
"""Entries are constructed in the first events, unless they start later."""

TARGETS = ("node", "main", "executable", "script", "module", "program")


@dataclass(frozen=True, slots=True)
class JobEntries:
    """``nodes`` are the full names of the nodes that an entry has constructed, by its number, as
    far as that is known. ``roots`` are the modules and files (``file:`` before them) that run in a
    main, by its name, and in a node, by its full name; with the files of parameters and of
    terminal input of its entry."""

    nodes: dict[int, set[str]]
    roots: dict[str, set[str]]


def job_entries(trace: Trace, job: dict[str, Any]) -> JobEntries:
    """Return what the entries of a job have made in its run."""
    mains = [one for one in trace.entities.values() if one.kind is EntityKind.MAIN]
    roots = {main.name: _roots(trace, main) for main in mains}
    of_any = set().union(*roots.values())
    waiting: dict[str, list[set[str]]] = {}
    for made in _constructed(trace):
        nodes = {one.name for one in made if one.kind is EntityKind.NODE}
        targets = [one.name for one in made if one.kind is EntityKind.MAIN]
        targets = targets or [one.type for one in made if one.kind is EntityKind.NODE]
        for target in targets[:1]:
            waiting.setdefault(target, []).append(nodes)
            for node in nodes:
                roots.setdefault(node, set()).update(roots.get(target, ()))
    for one in trace.entities.values():
        if one.kind is EntityKind.NODE:  # one that is made later is of any main
            own = {one.type.partition(":")[0]} - {"", "__main__"}
            roots.setdefault(one.name, set(of_any)).update(own)
    found = {}
    for number, entry in enumerate(job.get("nodes") or []):
        targets = [str(entry.get(key)) for key in TARGETS if entry.get(key)]
        if targets and entry.get("start_after") is None and waiting.get(targets[0]):
            found[number] = waiting[targets[0]].pop(0)
            typed = [one.get("file") for one in entry.get("stdin") or [] if isinstance(one, dict)]
            files = [*(entry.get("parameter_files") or []), *filter(None, typed)]
            for name in {*found[number], targets[0]} & roots.keys():
                roots[name].update(f"file:{path}" for path in files)
    return JobEntries(found, roots)


def module_of(place: str) -> str:
    """Return the module of a place: ``bot.arm`` of ``bot/arm.py:24``."""
    file = place.rpartition(":")[0]
    return file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _roots(trace: Trace, main: Entity) -> set[str]:
    """Return what a main runs: its file, and the module of its function."""
    return {f"file:{main.name}", module_of(main.source)} & trace.metadata(METADATA_SOURCES).keys()


def _constructed(trace: Trace) -> Iterator[list[Entity]]:
    """Yield what each constructor in the first events has made."""
    for part in trace.events(0, _EVENTS_MAX):
        for index in part["index"][part["kind"] == EventKind.CONSTRUCT].tolist():
            made = (part for part in trace.outputs(index, index + 1))
            ids = np.concatenate([p["entity"][p["kind"] == OutputKind.ENTITY] for p in made])
            yield [trace.entities[one] for one in ids.tolist()]
