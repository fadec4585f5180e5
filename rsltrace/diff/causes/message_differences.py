"""The messages in which two events differ, decoded where their payloads were recorded, and what
became of an output that only one of two events has: sent twice, sent later, done to a timer. The
trace has hashes of these; what they stand for is found by trying."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import islice, pairwise

import numpy as np

from rsltrace.diff.alignment.outputs import matched_outputs
from rsltrace.diff.alignment.rows import (
    TIMER,
    ComparedTrace,
    EventColumns,
    OutputRow,
    counts,
    load_rows,
    outputs_of,
)
from rsltrace.diff.causes.event_views import drawn_for, entity_detail
from rsltrace.diff.facts.evidence import (
    EventSummary,
    FieldDifference,
    MessageDifference,
    NoFieldsReason,
    OutputFate,
    OutputOrder,
    ParameterChanges,
    ParameterValues,
    Presence,
    SendCount,
    SendDelay,
    TimerCancellation,
    TimerPeriod,
)
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.values.fields import diff_messages, preview
from rsltrace.errors import TraceError
from rsltrace.trace.chain import hash64
from rsltrace.trace.format import TOPIC_DETAILS, TOPIC_ROSOUT
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    NO_SEQUENCE,
    EventKind,
    Output,
    OutputKind,
    decision_text,
)
from rsltrace.trace.model.operation import (
    PARAMETER_EVENTS,
    TIMER_CANCEL,
    TIMER_PERIOD,
    TIMER_RESET,
    pack_operation,
)
from rsltrace.trace.model.texts import contrasting, printable, shortened
from rsltrace.trace.words.code import output_places, relative_place
from rsltrace.trace.words.entities import EntityKey
from rsltrace.trace.words.events import output_text
from rsltrace.trace.words.logs import LogRecord
from rsltrace.trace.words.phrases import exception_of

MESSAGES_MAX = 50
"""Differing messages of one event that are decoded; one callback can publish thousands."""

_EXCEPTION_MAX = 200
_LOG_MAX = 100
_INPUT = -1
_WITH_PAYLOAD = frozenset(
    (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG)
)
_WITHOUT_INPUT = frozenset((EventKind.TIMER, EventKind.CONSTRUCT, EventKind.SHUTDOWN))


def message_differences(
    run_a: ComparedTrace,
    run_b: ComparedTrace,
    a: EventSummary | None,
    b: EventSummary | None,
    options: DiffOptions,
) -> tuple[MessageDifference, ...]:
    """Return the input and the outputs in which two events differ, the input first.

    Where one run has no such event, all of the other's. At most ``MESSAGES_MAX``.
    """
    evidence = _MessageComparison(run_a, run_b, options)
    found: list[MessageDifference] = []
    for difference in evidence.differences(a, b):
        if options.wants_topic(difference.topic):
            found.append(difference)
            if len(found) == MESSAGES_MAX:
                break
    return tuple(found)


_LOOKED_AT_MAX = 1000
"""Events in which an output is looked for that came later."""

_PARAMETERS_MAX = 3
_VALUES = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value"}
_ARRAYS = {6: "bool_array_value", 7: "integer_array_value", 8: "double_array_value"}
_ARRAYS |= {5: "byte_array_value", 9: "string_array_value"}
"""The field of a ``ParameterValue`` by its type."""

_SENT = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)
_CANCEL_HASH = hash64(pack_operation(TIMER_CANCEL, 0))


class _MessageComparison:
    def __init__(self, run_a: ComparedTrace, run_b: ComparedTrace, options: DiffOptions) -> None:
        self._run_a = run_a
        self._run_b = run_b
        self._options = options

    def differences(
        self, a: EventSummary | None, b: EventSummary | None
    ) -> Iterator[MessageDifference]:
        """Yield what differs between two events, of which one may be missing."""
        input_a, input_b = self._input(self._run_a, a), self._input(self._run_b, b)
        hash_a = a.input_hash if a is not None else None
        hash_b = b.input_hash if b is not None else None
        if (input_a or input_b) and hash_a != hash_b:
            yield self._difference(_INPUT, input_a, input_b, hash_a, hash_b)
        outputs_a = outputs_of(self._run_a, a.index) if a is not None else []
        outputs_b = outputs_of(self._run_b, b.index) if b is not None else []
        fates = _OutputChanges(self._run_a, self._run_b, a, b)
        bag = any(view is not None and _is_published_input(view) for view in (a, b))
        keys = self._run_a.matching.keys
        for position, x, y, moved in matched_outputs(outputs_a, outputs_b, keys):
            if not any(row and counts(self._run_a, row) for row in (x, y)):
                continue
            if bag and (x or y or (0,))[0] == OutputKind.MESSAGE:
                continue  # what is published is the input, shown already
            found = self._difference(position, x, y, x and x[2], y and y[2], moved=moved)
            places = self._places(self._run_a, x, a) + self._places(self._run_b, y, b)
            found = replace(found, code=tuple(dict.fromkeys(places)))
            one = x or y
            fate: OutputFate | None = None
            if x and y:
                fate = fates.timer_periods(x, y) if x[0] == OutputKind.TIMER else None
            elif one is not None:
                fate = fates.fate(one, (outputs_a, outputs_b), only_b=x is None)
            yield replace(found, fate=fate or found.fate)

    def _places(
        self, run: ComparedTrace, row: OutputRow | None, view: EventSummary | None
    ) -> list[str]:
        """Return the lines from which an output may have come."""
        if row is None or view is None:
            return []
        if row[0] not in _WITH_PAYLOAD and row[0] != OutputKind.DRAW:
            return []
        output = Output(view.index, _entity_id(run, row[1]), OutputKind(row[0]), row[2], row[3])
        return [relative_place(run.trace, place) for place in output_places(run.trace, output)]

    def _input(self, run: ComparedTrace, view: EventSummary | None) -> OutputRow | None:
        """Return the output that was an event's input; for a bag message, its own publication."""
        if view is None or view.kind in _WITHOUT_INPUT:
            return None
        if _is_published_input(view):
            outputs = outputs_of(run, view.index)
            return outputs[0] if outputs else None
        if view.cause_event == NO_EVENT or view.cause_event >= view.index:
            return None
        outputs = outputs_of(run, view.cause_event)
        if view.cause_output >= len(outputs):
            return None
        output = outputs[view.cause_output]
        return output if output[0] in _WITH_PAYLOAD else None

    def _difference(
        self,
        position: int,
        a: OutputRow | None,
        b: OutputRow | None,
        hash_a: int | None,
        hash_b: int | None,
        *,
        moved: bool = False,
    ) -> MessageDifference:
        one = a or b
        assert one is not None
        kind, number, _, _ = one
        keys = self._run_a.matching.keys
        key = keys[number]
        presence = Presence.BOTH if a and b else Presence.ONLY_A if a else Presence.ONLY_B
        topic = _topic(kind, key)
        base = MessageDifference(
            kind=None if position == _INPUT else OutputKind(kind),
            topic=topic,
            type=key.type,
            position=position,
            presence=presence,
            hash_a=hash_a,
            hash_b=hash_b,
            fate=OutputOrder() if moved else None,
            entity=key,
        )
        if moved or kind == OutputKind.ENTITY:
            return base
        if kind == OutputKind.DRAW:
            text_a, text_b = contrasting(a and a[2], b and b[2], _decision)
            return replace(base, fields=(FieldDifference("draw", text_a, text_b),))
        values: list[object] = []
        for run, output in ((self._run_a, a), (self._run_b, b)):
            if output is None:
                continue
            try:
                value = self._decoded(run, output)
            except TraceError as error:
                return replace(base, no_fields=NoFieldsReason.UNREADABLE, error=str(error))
            if value is None and kind not in _WITH_PAYLOAD:
                return base
            if value is None:
                return replace(base, no_fields=_NOT_RECORDED[run.of_b])
            values.append(value)
        if kind == OutputKind.EXCEPTION:
            raised = [_exception(value) for value in values]
            if len(raised) == 1:
                return replace(base, preview=raised[0])
            return replace(base, fields=(FieldDifference("raised", raised[0], raised[1]),))
        if len(values) == 1:
            was_set = _parameters_set(values[0]) if topic == PARAMETER_EVENTS else ()
            became = ParameterValues(was_set) if was_set else None
            text = _log_text(values[0]) if kind == OutputKind.LOG else ""
            return replace(base, preview=text or preview(values[0]), fate=became)
        fields, more = diff_messages(values[0], values[1], self._options.for_topic(topic))
        no_fields = None
        if not fields:
            no_fields = (
                NoFieldsReason.ALL_IGNORED if self._options.ignore else NoFieldsReason.EQUAL_FIELDS
            )
        changed = _parameters_changed(*values) if topic == PARAMETER_EVENTS else ()
        fate = ParameterChanges(changed) if changed else None
        return replace(base, fields=fields, more_fields=more, no_fields=no_fields, fate=fate)

    def _decoded(self, run: ComparedTrace, row: OutputRow) -> object | None:
        """Return the decoded payload of an output (a text for a detail), None if not recorded."""
        kind, number, content, sequence = row
        if sequence == NO_SEQUENCE:
            return None
        trace = run.trace
        entity = _entity_id(run, number)
        output = Output(0, entity, OutputKind(kind), content, sequence)
        if kind not in _WITH_PAYLOAD:
            return trace.detail(output)
        channel = trace.channel_of(output)
        found = trace.payload(output)
        if channel is None or found is None or channel.topic == TOPIC_DETAILS:
            return None
        return trace.decode(channel, found[2])


_NOT_RECORDED = (NoFieldsReason.NOT_RECORDED_IN_A, NoFieldsReason.NOT_RECORDED_IN_B)


def _decision(number: int | None, digits: int) -> str:
    return "none" if number is None else decision_text(number, digits)


def _exception(traceback: object) -> str:
    return shortened(printable(exception_of(str(traceback))), _EXCEPTION_MAX)


def _log_text(record: object) -> str:
    """Return a log record as a person reads it: ``WARN "text"``; "" if it is none."""
    level, text = getattr(record, "level", None), getattr(record, "msg", None)
    if not isinstance(level, int) or not isinstance(text, str):
        return ""
    record = LogRecord(level, "", text)
    return shortened(f'{record.level_name} "{printable(text)}"', _LOG_MAX)


def _topic(kind: int, key: EntityKey) -> str:
    """Return the topic of an output with a payload; of others what they are."""
    if kind == OutputKind.LOG:
        return TOPIC_ROSOUT
    if kind in _WITH_PAYLOAD:
        return key.name
    return drawn_for(key) if kind == OutputKind.DRAW else output_text(kind, key.name, key.kind)


def _is_published_input(view: EventSummary) -> bool:
    """Return whether an event publishes what it got from outside: a bag's message, a driver's."""
    if view.kind is EventKind.OUTSIDE:
        return view.entity.kind == EntityKind.PUBLISHER.label
    return view.kind is EventKind.BAG


def _entity_id(run: ComparedTrace, number: int) -> int:
    table = run.matching.numbers_b if run.of_b else run.matching.numbers_a
    return int((table == number).nonzero()[0][0])


# -- what became of an output --------------------------------------------------------------------


class _OutputChanges:
    """What became of the outputs of one pair of events."""

    def __init__(
        self,
        run_a: ComparedTrace,
        run_b: ComparedTrace,
        a: EventSummary | None,
        b: EventSummary | None,
    ) -> None:
        self._runs = (run_a, run_b)
        self._views = (a, b)

    def fate(
        self, row: OutputRow, outputs: tuple[list[OutputRow], list[OutputRow]], *, only_b: bool
    ) -> OutputFate | None:
        """Return what became of an output that only one run has, None if that is all."""
        if None in self._views:
            return None
        in_a, in_b = (sum(other[:3] == row[:3] for other in side) for side in outputs)
        name = "b" if only_b else "a"
        if row[0] in _SENT and in_a and in_b:
            return SendCount(in_a, in_b)
        if row[0] == OutputKind.TIMER:
            return self._done_to_timer(row, name, only_b=only_b)
        return self._later(row, only_b=only_b) if row[0] in _SENT else None

    @cached_property
    def _rows(self) -> tuple[EventColumns, EventColumns]:
        rows = []
        for run, view in zip(self._runs, self._views, strict=True):
            assert view is not None
            rows.append(load_rows(run, view.index, view.index + _LOOKED_AT_MAX))
        return rows[0], rows[1]

    def _later(self, row: OutputRow, *, only_b: bool) -> SendDelay | None:
        """Say whether the other run sends the same later, and then what this one sends."""
        has, has_not = self._rows[::-1] if only_b else self._rows
        mine, theirs = (list(islice(_sent(rows, row), 2)) for rows in (has, has_not))
        if not mine or not theirs:
            return None
        late_ns = theirs[0][0] - mine[0][0]
        contents, others = ([content for _, content in sent] for sent in (mine, theirs))
        repeats = len(set(contents)) < len(contents)
        if late_ns <= 0 or contents != others or (repeats and mine[1:] != theirs[1:]):
            return None  # another one, of a sender that often sends the same
        return SendDelay(late_ns, "a" if only_b else "b")

    def timer_periods(self, a: OutputRow, b: OutputRow) -> TimerPeriod | None:
        """Return the periods of a timer that both runs set or reset to another deadline."""
        found = []
        for run, view, rows, (_, number, content, _) in zip(
            self._runs, self._views, self._rows, (a, b), strict=True
        ):
            assert view is not None
            known = [entity_detail(run, number).get("period_ns"), *_periods(rows, number)]
            for period_ns in (one for one in known if isinstance(one, int)):
                reset = pack_operation(TIMER_RESET, view.stamp_ns + period_ns)
                if content in (hash64(reset), hash64(pack_operation(TIMER_PERIOD, period_ns))):
                    found.append(period_ns)
                    break
        return TimerPeriod(found[0], found[1]) if len({*found}) == 2 else None

    def _done_to_timer(self, row: OutputRow, name: str, *, only_b: bool) -> OutputFate | None:
        _, number, content, _ = row
        if content == _CANCEL_HASH:
            return TimerCancellation(name)
        mine, theirs = self._rows[::-1] if only_b else self._rows
        for period_ns in _periods(mine, number):
            if hash64(pack_operation(TIMER_PERIOD, period_ns)) == content:
                before_ns = next(iter(_periods(theirs, number)), None)
                return TimerPeriod(before_ns, period_ns, name)
        return None


def _parameters_set(event: object) -> tuple[tuple[str, str], ...]:
    """Return the parameters that a ``ParameterEvent`` sets."""
    return tuple(_parameters(event).items())[:_PARAMETERS_MAX]


def _parameters_changed(a: object, b: object) -> tuple[tuple[str, str, str], ...]:
    """Return which of the parameters differ that two ``ParameterEvent`` set."""
    of_a, of_b = _parameters(a), _parameters(b)
    both = [name for name in of_a if name in of_b and of_a[name] != of_b[name]]
    return tuple((name, of_a[name], of_b[name]) for name in both[:_PARAMETERS_MAX])


def _parameters(event: object) -> dict[str, str]:
    found = {}
    for name in ("new_parameters", "changed_parameters"):
        for parameter in getattr(event, name, ()):
            value = getattr(parameter, "value", None)
            kind = getattr(value, "type", 0)
            if kind in _VALUES:
                text = str(getattr(value, _VALUES[kind], ""))
            elif kind in _ARRAYS:
                text = str(np.asarray(getattr(value, _ARRAYS[kind], ())).tolist())
            else:
                continue
            found[printable(str(parameter.name))] = printable(text)
    return found


def _sent(rows: EventColumns, row: OutputRow) -> Iterator[tuple[int, int]]:
    """Yield (stamp, content) of an output and of what its sender sends from there on."""
    found = False
    for place, stamp in enumerate(rows.stamp):
        if rows.output_counts[place]:
            for output in rows.outputs(rows.first + place):
                found = found or output[:3] == row[:3]
                if found and output[:2] == row[:2]:
                    yield stamp, output[2]


def _periods(rows: EventColumns, number: int) -> list[int]:
    """Return the times between the events of a timer, each once."""
    stamps = [
        rows.stamp[place]
        for place, (other, kind) in enumerate(zip(rows.number, rows.kind, strict=True))
        if other == number and kind == TIMER
    ]
    return list(dict.fromkeys(late - early for early, late in pairwise(stamps)))
