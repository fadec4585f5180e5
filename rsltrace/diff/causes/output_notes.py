"""What became of an output that only one of two events has: sent twice, sent later, and what was
done to a timer. The trace has hashes of these; what they stand for is found by trying."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import islice, pairwise

from rsltrace.diff.alignment.rows import TIMER, OutputRow, Rows, Run, load_rows
from rsltrace.diff.result.events import EventView
from rsltrace.model.event import OutputKind
from rsltrace.model.operation import TIMER_CANCEL, TIMER_PERIOD, pack_operation
from rsltrace.model.printable import printable, shortened
from rsltrace.model.stamp import format_duration
from rsltrace.trace.chain import hash64

IN_ANOTHER_ORDER = "in another order"

_LOOKED_AT_MAX = 1000
"""Events in which an output is looked for that came later."""

_PARAMETERS_MAX = 3
_VALUE_MAX = 40
_VALUES = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value"}
"""The field of a ``ParameterValue`` by its type."""

_SENT = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)
_CANCEL_HASH = hash64(pack_operation(TIMER_CANCEL, 0))


class OutputNotes:
    """Notes on the outputs of one pair of events."""

    def __init__(self, run_a: Run, run_b: Run, a: EventView | None, b: EventView | None) -> None:
        self._runs = (run_a, run_b)
        self._views = (a, b)

    def note(
        self, row: OutputRow, outputs: tuple[list[OutputRow], list[OutputRow]], *, only_b: bool
    ) -> str:
        """Return what became of an output that only one run has, "" if that is all."""
        if None in self._views:
            return ""
        in_a, in_b = (sum(other[:3] == row[:3] for other in side) for side in outputs)
        name = "b" if only_b else "a"
        if row[0] in _SENT and in_a and in_b:
            times = {(1, 2): "twice in b", (2, 1): "twice in a"}
            return times.get((in_a, in_b), f"{in_a} times in a, {in_b} times in b")
        if row[0] == OutputKind.TIMER:
            done = self._done_to_timer(row, only_b=only_b)
            return f"{done} in {name}" if done else ""
        return self._later(row, only_b=only_b) if row[0] in _SENT else ""

    @cached_property
    def _rows(self) -> tuple[Rows, Rows]:
        rows = []
        for run, view in zip(self._runs, self._views, strict=True):
            assert view is not None
            rows.append(load_rows(run, view.index, view.index + _LOOKED_AT_MAX))
        return rows[0], rows[1]

    def _later(self, row: OutputRow, *, only_b: bool) -> str:
        """Say whether the other run sends the same later, and from there on as this one."""
        has, has_not = self._rows[::-1] if only_b else self._rows
        mine, theirs = (list(islice(_sent(rows, row), 2)) for rows in (has, has_not))
        if not mine or not theirs:
            return ""
        late_ns = theirs[0][0] - mine[0][0]
        moved = [(stamp + late_ns, content) for stamp, content in mine]
        repeats = len({content for _, content in mine}) < len(mine)
        if late_ns <= 0 or (mine[1:] != theirs[1:] and (repeats or moved != theirs)):
            return ""  # another one, of a sender that often sends the same
        return f"{format_duration(late_ns)} later in {'a' if only_b else 'b'}"

    def _done_to_timer(self, row: OutputRow, *, only_b: bool) -> str:
        _, number, content, _ = row
        if content == _CANCEL_HASH:
            return "cancelled"
        mine, theirs = self._rows[::-1] if only_b else self._rows
        for period_ns in _periods(mine, number):
            if hash64(pack_operation(TIMER_PERIOD, period_ns)) == content:
                before_ns = next(iter(_periods(theirs, number)), None)
                if before_ns is None:
                    return f"set to a period of {format_duration(period_ns)}"
                return f"period {durations(before_ns, period_ns)}"
        return ""


def parameters_text(event: object) -> str:
    """Return the parameters that a ``ParameterEvent`` sets: ``gain = 9.5``."""
    found = [f"{name} = {value}" for name, value in _parameters(event).items()]
    return ", ".join(found[:_PARAMETERS_MAX])


def parameter_changes(a: object, b: object) -> str:
    """Return which of the parameters differ that two ``ParameterEvent`` set: ``gain 2 → 2.5``."""
    of_a, of_b = _parameters(a), _parameters(b)
    both = [name for name in of_a if name in of_b and of_a[name] != of_b[name]]
    found = [f"{name} {of_a[name]} → {of_b[name]}" for name in both]
    return ", ".join(found[:_PARAMETERS_MAX])


def _parameters(event: object) -> dict[str, str]:
    found = {}
    for name in ("new_parameters", "changed_parameters"):
        for parameter in getattr(event, name, ()):
            value = getattr(parameter, "value", None)
            field = _VALUES.get(getattr(value, "type", 0))
            if field is not None:
                text = shortened(printable(str(getattr(value, field, ""))), _VALUE_MAX)
                found[printable(str(parameter.name))] = text
    return found


def durations(one_ns: int, other_ns: int) -> str:
    """Return two durations, with one unit where that is the same: ``20 → 26 ms``."""
    one, other = format_duration(one_ns), format_duration(other_ns)
    (number, unit), (_, other_unit) = one.split(), other.split()
    return f"{number} → {other}" if unit == other_unit else f"{one} → {other}"


def _sent(rows: Rows, row: OutputRow) -> Iterator[tuple[int, int]]:
    """Yield (stamp, content) of an output and of what its sender sends from there on."""
    found = False
    for place, stamp in enumerate(rows.stamp):
        if rows.output_counts[place]:
            for output in rows.outputs(rows.first + place):
                found = found or output[:3] == row[:3]
                if found and output[:2] == row[:2]:
                    yield stamp, output[2]


def _periods(rows: Rows, number: int) -> list[int]:
    """Return the times between the events of a timer, each once."""
    stamps = [
        rows.stamp[place]
        for place, (other, kind) in enumerate(zip(rows.number, rows.kind, strict=True))
        if other == number and kind == TIMER
    ]
    return list(dict.fromkeys(late - early for early, late in pairwise(stamps)))
