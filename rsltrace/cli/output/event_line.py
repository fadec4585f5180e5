"""One event as a line of aligned columns, for ``rsltrace cat``."""

from __future__ import annotations

from itertools import chain

from rsltrace.trace.model.event import Event, Output, OutputKind
from rsltrace.trace.model.finding import Finding
from rsltrace.trace.model.printable import printable, shortened
from rsltrace.trace.model.stamp import format_seconds
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.code import code_places, output_places, places_text
from rsltrace.trace.words.events import EventWords
from rsltrace.trace.words.kinds import flag_names

_VALUE_MAX = 200
_COLUMN_MAX = 40
"""A column is as wide as its longest name, up to here; longer names push the rest to the right."""


class EventLines:
    """Writes the events of a trace as lines.

    Index, simulated seconds, node, kind, entity, input hash, output hash, outputs, flags. Columns
    without a value hold ``-``; outputs and flags come last because they have any length. With
    ``code``, the place of the function that ran comes before the outputs, and each of these has its
    line.
    """

    def __init__(self, trace: Trace, *, code: bool = False) -> None:
        self._trace = trace
        made = (entity.source for entity in trace.entities.values())
        ran = (line.place for lines in trace.code_lines.values() for line in lines)
        places = list(map(printable, chain(made, ran))) if code else []
        self._code_width = min(max(map(len, places), default=0), _COLUMN_MAX)
        self._findings = trace.findings
        self._more = self._from_where if code else lambda output: ""
        self._words = EventWords(trace)
        names = self._words.names
        self._index_width = max(len(str(trace.event_count)), 5)
        self._time_width = len(format_seconds(trace.end_ns))
        self._node_width = min(max(names.longest_node, 1), _COLUMN_MAX)
        self._name_width = min(max(names.longest_name, 1), _COLUMN_MAX)

    def line(self, event: Event, outputs: list[Output]) -> str:
        """Return the line of an event, without a line end; findings of the guard on their own."""
        node = self._words.node(event, outputs) or "-"
        name = self._words.names.name(event.entity) or "-"
        columns = (
            f"{event.index:>{self._index_width}}  "
            f"{format_seconds(event.stamp_ns):>{self._time_width}}  "
            f"{node:<{self._node_width}}  {event.kind.label:<15}  {name:<{self._name_width}}  "
            f"{_hex(event.input_hash):<16}  {_hex(event.output_hash):<16}"
        )
        if self._code_width:
            place = printable(places_text(code_places(self._trace, event))) or "-"
            columns += f"  {place:<{self._code_width}}"
        what = ", ".join(self._words.outputs(outputs, self._more))
        flags = "".join(f"  [{flag}]" for flag in flag_names(event.flags))
        found = self._findings.get(event.index, ())
        lines = [f"{columns}  {what}{flags}".rstrip(), *map(self._finding, found)]
        return "\n".join(lines)

    def _from_where(self, output: Output) -> str:
        if output.kind is OutputKind.DRAW:
            return ""  # it says so itself
        places = printable(places_text(output_places(self._trace, output)))
        return f"at {places}" if places else ""

    def _finding(self, finding: Finding) -> str:
        where = printable(finding.stack.partition("\n")[0])
        return (
            f"{'':>{self._index_width}}  ! {finding.source.value} {finding.mode.value}: "
            f"{printable(finding.call)} -> "
            f"{shortened(printable(finding.value), _VALUE_MAX)}  at {where}"
        )


def _hex(value: int) -> str:
    return f"{value:016x}" if value else "-"
