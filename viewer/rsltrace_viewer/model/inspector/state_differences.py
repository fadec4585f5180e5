"""What differs between two runs beside messages, as lines: states of nodes, calls from outside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rsltrace.diff.alignment.rows import Run as DiffRun
from rsltrace.diff.causes.state_differences import state_differences
from rsltrace.diff.facts.evidence import CallDifference, EventView, StateDifference
from rsltrace.diff.result import Divergence
from rsltrace.trace.model.printable import printable, shortened
from rsltrace_viewer.model.inspector.lines import Line, Openness, Role

_VALUE_MAX = 200


def differing_state_lines(
    runs: tuple[DiffRun, DiffRun],
    views: tuple[EventView | None, EventView | None],
    divergence: Divergence | None,
    openness: Openness,
) -> Iterator[Line]:
    """Yield the attributes in which a node's states differ after an event of both runs.

    At the divergence they are known and shown; elsewhere they are looked for when opened.
    """
    a, b = views
    if (
        a is None
        or b is None
        or not (a.state_hash and b.state_hash)
        or a.state_hash == b.state_hash
    ):
        return
    is_open = openness.is_open("states", divergence is not None)
    yield Line(0, "≠ state", f"of {a.entity.node} after it", Role.SECTION, "states", is_open)
    if not is_open:
        return
    found: Sequence[StateDifference]
    found = divergence.state if divergence is not None else state_differences(*runs, a, b)
    for place, one in enumerate(found):
        path = f"states.{place}"
        yield Line(1, "", printable(one.path), Role.DIFFERENCE, path)
        for name, value in (("a", one.a), ("b", one.b)):
            text = "not there" if value is None else shortened(printable(value), _VALUE_MAX)
            yield Line(2, name, text, Role.FIELD, f"{path}.{name}")
    if not found:
        hint = "only hashes were recorded; guard: {state: record} in the job keeps the values"
        yield Line(1, "", hint, Role.NOTE, "states.none")


def differing_call_lines(calls: Sequence[CallDifference]) -> Iterator[Line]:
    """Yield the calls from outside that gave different answers, in the event or before it."""
    for place, call in enumerate(call for call in calls if call.a != call.b):
        path = f"calls.{place}"
        yield Line(0, "≠ call", f"{call.source}: {printable(call.call)}", Role.SECTION, path)
        yield Line(1, "at", printable(call.where), Role.NOTE, f"{path}.at")
        for name, value, event in (("a", call.a, call.event_a), ("b", call.b, call.event_b)):
            text = "not called" if value is None else shortened(printable(value), _VALUE_MAX)
            link = event if value is not None else None
            yield Line(
                1, name, text, Role.FIELD, f"{path}.{name}", link=link, other_run=name == "b"
            )
