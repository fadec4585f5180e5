"""An event of one of the runs, as a report shows it."""

from __future__ import annotations

from dataclasses import dataclass

from rsltrace.model.event import EventFlag, EventKind
from rsltrace.words.entities import EntityKey


@dataclass(frozen=True, slots=True)
class EventView:
    """One event of one run, resolved for printing.

    ``position`` counts the events of this entity before it; -1 far into a long run, where counting
    would mean reading all of it. A constructor goes by the node it makes. ``summary`` is a short
    text of its outputs (``/t1, call /s1``), ``code`` where the function that ran is
    (``module.py:24``): by its path in the present folder if it is found below that.
    """

    index: int
    stamp_ns: int
    entity: EntityKey
    kind: EventKind
    flags: EventFlag
    cause_event: int
    cause_output: int
    input_hash: int
    output_hash: int
    state_hash: int
    outputs: int
    position: int
    summary: str = ""
    code: str = ""
