"""Events as rows of a report."""

from __future__ import annotations

from rsltrace.diff.facts.evidence import EventView
from rsltrace.diff.report.line import Piece, Style
from rsltrace.model.printable import printable
from rsltrace.model.stamp import format_seconds
from rsltrace.words.kinds import flag_names
from rsltrace.words.phrases import event_title


def event_text(event: EventView) -> str:
    """Return ``/filter: subscription /scan``, or what else ran."""
    return event_title(event.kind, event.entity)


def event_cells(event: EventView) -> list[Piece]:
    """Return an event as cells of a table: index, time, what ran, what it did."""
    flags = (f"[{name}]" for name in flag_names(event.flags))
    done = ", ".join(filter(None, [printable(event.summary), *flags]))
    return [
        (str(event.index), Style.FAINT),
        (format_seconds(event.stamp_ns), Style.FAINT),
        (event_text(event), ""),
        (f"-> {done}" if done else "", ""),
    ]


def event_key(event: EventView) -> tuple[object, ...]:
    """Return what is equal for events that are the same but for their place in the run."""
    return (
        event.entity,
        event.stamp_ns,
        event.kind,
        event.input_hash,
        event.output_hash,
        event.flags,
    )
