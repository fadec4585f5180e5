"""``rsltrace cat``: the events of a trace, one per line."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError, near_or_all
from rsltrace.fast_dataclass import dataclass
from rsltrace.terminal import line_writer, say, tell, tell_notes, terminal_width
from rsltrace.trace.format import TOPIC_DETAILS
from rsltrace.trace.model.entity import WITH_TOPIC, Entity, EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    NO_SEQUENCE,
    EventKind,
    EventRecord,
    Output,
    OutputKind,
    decision_text,
    is_switch,
)
from rsltrace.trace.model.finding import Finding
from rsltrace.trace.model.texts import format_seconds, printable, shortened
from rsltrace.trace.reader import Trace
from rsltrace.trace.segments import event_of, output_of
from rsltrace.trace.words.code import code_place, code_places, output_places, places_text
from rsltrace.trace.words.entities import flag_names
from rsltrace.trace.words.events import EventWords
from rsltrace.trace.words.logs import log_record
from rsltrace.trace.words.phrases import notes_on, path_word

if TYPE_CHECKING:
    from rsltrace.checks.conditions.trace_events import TraceCondition
    from rsltrace.job.values.times import TimeInRun


_WITH_MESSAGE = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG)
_WITH_PLACE = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.LOG)


class EventJson:
    """Converts events to JSON objects; ``payloads`` adds decoded messages."""

    def __init__(self, trace: Trace, *, payloads: bool) -> None:
        self._trace = trace
        self._payloads = payloads

    def object(self, event: EventRecord, outputs: list[Output]) -> dict[str, Any]:
        """Return an event as JSON-compatible values. Hashes are 16 hex digits, since JSON readers
        lose digits of 64-bit numbers."""
        caused = event.cause_event != NO_EVENT
        return {
            "index": event.index,
            "stamp_ns": event.stamp_ns,
            "time": format_seconds(event.stamp_ns),
            "kind": event.kind.label,
            **self._entity(event.entity),
            "cause_event": event.cause_event if caused else None,
            "cause_output": event.cause_output if caused else None,
            "input_hash": f"{event.input_hash:016x}",
            "output_hash": f"{event.output_hash:016x}",
            "state_hash": f"{event.state_hash:016x}" if event.state_hash else None,
            "chain_hash": f"{event.chain_hash:016x}",
            "code": code_place(self._trace, event) or None,
            "flags": flag_names(event.flags),
            "outputs": [self._output(output) for output in outputs],
            "findings": [
                {
                    "source": finding.source.value,
                    "mode": finding.mode.value,
                    "call": finding.call,
                    "value": finding.value,
                    "stack": finding.stack.splitlines(),
                }
                for finding in self._trace.findings.get(event.index, ())
            ],
        }

    def _entity(self, entity_id: int) -> dict[str, Any]:
        entity = self._trace.entities.get(entity_id)
        if entity is None:
            return {"entity": entity_id, "entity_kind": None, "node": None, "name": None}
        owner = self._trace.entities.get(entity.node)
        return {
            "entity": entity_id,
            "entity_kind": entity.kind.name.lower(),
            "node": owner.name or None if owner else None,
            "name": entity.name or None,
        }

    def _output(self, output: Output) -> dict[str, Any]:
        kept = output.sequence != NO_SEQUENCE
        result = {
            "kind": output.kind.label,
            **self._entity(output.entity),
            "hash": f"{output.hash:016x}",
            "sequence": output.sequence if kept else None,
        }
        if output.kind in _WITH_PLACE or (
            output.kind is OutputKind.DRAW and is_switch(output.hash)
        ):
            result["code"] = output_places(self._trace, output)
        if output.kind is OutputKind.DRAW:
            result["text"] = decision_text(output.hash)
        if output.kind is OutputKind.LOG and kept:
            record = log_record(self._trace, output)
            result["level"] = record.level_name if record else ""
            result["text"] = record.text if record else ""
        found = self._trace.payload(output) if kept and self._wants_payload(output) else None
        if found is not None:
            _, topic, data = found
            if topic == TOPIC_DETAILS:
                result["text"] = self._trace.detail(output)
            else:
                from rsltrace.trace.decode import to_plain

                channel = self._trace.channel_of(output)
                assert channel is not None
                result["topic"] = topic
                result["type"] = channel.type
                result["message"] = to_plain(self._trace.decode(channel, data))
        return result

    def _wants_payload(self, output: Output) -> bool:
        """Details are short and always printed; messages only when asked for."""
        return self._payloads or output.kind not in _WITH_MESSAGE


_VALUE_MAX = 200
_COLUMN_MAX = 40
"""A column is as wide as its longest name, up to here; longer names push the rest to the right."""
_HASHES, _OUTPUTS_MIN = 60, 30
"""How wide the hashes, the kind and the gaps are; and what is to be left for the outputs."""


class EventLines:
    """Formats the events of a trace as lines.

    Columns without a value hold ``-``; outputs and flags come last because their length varies.
    With ``code``, the source line of the callback comes before the outputs, and each output has its
    own. Where hashes would leave no room for outputs in a ``width``, they are left out.
    """

    def __init__(self, trace: Trace, *, code: bool = False, width: int | None = None) -> None:
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
        self._start_ns = trace.start_ns
        ends = [trace.end_ns, *trace.segments["start_stamp"][:1].tolist()]
        self._time_width = max(len(format_seconds(at - self._start_ns)) for at in ends)
        self._node_width = min(max(names.longest_node, 1), _COLUMN_MAX)
        self._name_width = min(max(names.longest_name, 1), _COLUMN_MAX)
        before = self._index_width + self._time_width + self._node_width + self._name_width
        self._hashes = width is None or before + _HASHES + _OUTPUTS_MIN <= width

    def line(self, event: EventRecord, outputs: list[Output]) -> str:
        """Return the line of an event, then a line for each finding of the guard in it."""
        node = self._words.node(event, outputs) or "-"
        name = self._words.names.name(event.entity) or "-"
        columns = (
            f"{event.index:>{self._index_width}}  "
            f"{format_seconds(event.stamp_ns - self._start_ns):>{self._time_width}}  "
            f"{node:<{self._node_width}}  {event.kind.label:<15}  {name:<{self._name_width}}"
        )
        if self._hashes:
            columns += f"  {_hex(event.input_hash):<16}  {_hex(event.output_hash):<16}"
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
            return ""  # its text has the line
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


class RunTimeParam(click.ParamType):  # type: ignore[type-arg]  # not generic before click 8.2
    """A time of the run, or a simulated time after ``@``."""

    name = "time"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> TimeInRun:
        """Return the time, or end with a usage error."""
        from rsltrace.job.values.times import TimeInRun, parse_time_in_run

        if isinstance(value, TimeInRun):
            return value
        try:
            return parse_time_in_run(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per line.")
@click.option("--payloads", is_flag=True, help="With --json: include the decoded messages.")
@click.option(
    "--code",
    is_flag=True,
    help="Add the source line of each callback (module.py:24) and of its outputs. 'or elsewhere' "
    "marks an output whose line was not recorded.",
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="GLOB",
    help="Print only events that receive from or send to these topics or services.",
)
@click.option(
    "--node", "nodes", multiple=True, metavar="GLOB", help="Print only events of these nodes."
)
@click.option(
    "--entity",
    "entities",
    multiple=True,
    metavar="ID|GLOB",
    help="Print only events of these entities, by id or name.",
)
@click.option(
    "--kind",
    "kinds",
    multiple=True,
    type=click.Choice([kind.label for kind in EventKind]),
    help="Print only events of this kind.",
)
@click.option(
    "--from",
    "first",
    type=RunTimeParam(),
    metavar="T",
    help="Start at time T of the run: seconds, or with a unit (90s, 5ms). @T is a simulated time.",
)
@click.option("--to", "last", type=RunTimeParam(), metavar="T", help="End at time T, inclusive.")
@click.option(
    "--where",
    metavar="CONDITION",
    help="Print only events that match a condition, written as a breakpoint: "
    "'/odom: pose.pose.position.x > 3', 'log warn', 'exception'.",
)
@click.option("--limit", type=click.IntRange(min=0), metavar="N", help="Print at most N events.")
def cat(
    trace: Path,
    as_json: bool,
    payloads: bool,
    code: bool,
    topics: tuple[str, ...],
    nodes: tuple[str, ...],
    entities: tuple[str, ...],
    kinds: tuple[str, ...],
    first: TimeInRun | None,
    last: TimeInRun | None,
    where: str | None,
    limit: int | None,
) -> None:
    """Print the events of TRACE, one per line, in the order they happened.

    The columns are: index, seconds since the start of the run, node, kind, entity, hash of the
    input, hash of the outputs, outputs (/topic, call /service, reply /service, log LEVEL text and
    so on), and [flags]. A narrow terminal shows no hashes. A line that starts with "!" is a finding
    of the guard in the event above it. Built-in entities of rclpy (such as /rosout) are shown only
    as a count; --json lists them.

    All filter options are repeatable, except times. An event is printed if it matches at least one
    value of every option given. Globs match whole names: --topic '/robot1/*'.
    """
    if payloads and not as_json:
        raise click.UsageError("--payloads needs --json")
    with Trace.open(trace) as opened:
        tell_notes(notes_on(opened))
        choice = _choice(opened, topics, nodes, entities, kinds, first, last)
        condition = None if where is None else _condition(where, opened)
        events = _events(opened, choice, condition)
        write = line_writer()
        lines = EventLines(opened, code=code, width=terminal_width())
        form = _json_form(opened, payloads) if as_json else lines.line
        for event, outputs in islice(events, limit):
            write(form(event, outputs))


def _condition(text: str, trace: Trace) -> TraceCondition:
    from rsltrace.checks.conditions.trace_events import TraceCondition

    return TraceCondition(text, trace)


def _json_form(trace: Trace, payloads: bool) -> Callable[[EventRecord, list[Output]], str]:
    make = EventJson(trace, payloads=payloads).object
    return lambda event, outputs: json.dumps(make(event, outputs), allow_nan=False)


@dataclass(frozen=True, slots=True)
class _EventFilter:
    """Which events to print. None stands for all; arrays are sorted."""

    entities: npt.NDArray[np.uint32] | None
    touching: npt.NDArray[np.uint32] | None
    kinds: npt.NDArray[np.uint8] | None
    from_ns: int
    to_ns: int


def _choice(
    trace: Trace,
    topics: tuple[str, ...],
    nodes: tuple[str, ...],
    entities: tuple[str, ...],
    kinds: tuple[str, ...],
    first: TimeInRun | None,
    last: TimeInRun | None,
) -> _EventFilter:
    everything = list(trace.entities.values())
    wanted: set[int] | None = None
    touching = None
    if nodes:
        owners = _named(trace, "node", nodes, [e for e in everything if e.kind is EntityKind.NODE])
        wanted = {e.id for e in everything if e.node in owners}
    if entities:
        named = _named(trace, "entity", entities, everything, by_id=True)
        wanted = named if wanted is None else wanted & named
    if topics:
        with_topic = [e for e in everything if e.kind in WITH_TOPIC]
        on_topic = _named(trace, "topic or service", topics, with_topic)
        touching = np.array(sorted(on_topic), dtype=np.uint32)
    labels = [kind for kind in EventKind if kind.label in kinds]
    from_ns = 0 if first is None else first.stamp_ns(trace.start_ns, trace.end_ns)
    if from_ns > trace.end_ns:
        end = format_seconds(trace.end_ns - trace.start_ns)
        tell_notes([f"--from is after the end of {trace.name}, {end} s"])
    to_ns = 2**64 - 1 if last is None else last.stamp_ns(trace.start_ns, trace.end_ns)
    if to_ns < from_ns:
        raise TraceError("--to is before --from")
    return _EventFilter(
        entities=None if wanted is None else np.array(sorted(wanted), dtype=np.uint32),
        touching=touching,
        kinds=np.array(labels, dtype=np.uint8) if kinds else None,
        from_ns=from_ns,
        to_ns=to_ns,
    )


def _named(
    trace: Trace, what: str, globs: tuple[str, ...], there: list[Entity], *, by_id: bool = False
) -> set[int]:
    """Return the entities that match one of ``globs``.

    :raises TraceError: a glob matches nothing, so that a typing mistake does not look like a run
        in which nothing happened.
    """
    names = sorted({entity.name for entity in there if entity.name})
    found: set[int] = set()
    for glob in globs:
        matching = {
            e.id
            for e in there
            if (e.name and fnmatchcase(e.name, glob)) or (by_id and str(e.id) == glob)
        }
        if not matching:
            near = near_or_all(glob, names)
            raise TraceError(f"{trace.name} has no {what} {printable(glob)}{near}")
        found |= matching
    return found


def _events(
    trace: Trace, choice: _EventFilter, where: TraceCondition | None
) -> Iterator[tuple[EventRecord, list[Output]]]:
    """Yield the chosen events with their outputs; memory is that of one segment."""
    segments = trace.segments
    for segment in segments:
        if segment["end_stamp"] < choice.from_ns or segment["start_stamp"] > choice.to_ns:
            continue
        first = int(segment["first_event"])
        last = first + int(segment["events"])
        events = next(trace.events(first, last))
        outputs = next(trace.outputs(first, last))
        ends = np.searchsorted(outputs["event"], events["index"], side="right").tolist()
        mask = _mask(events, outputs, choice)
        if where is not None and where.entities is not None:
            mask &= _touching(events, outputs, where.entities)
        for position in np.flatnonzero(mask).tolist():
            begin = ends[position - 1] if position else 0
            own = [output_of(row, trace.name) for row in outputs[begin : ends[position]]]
            event = event_of(events[position], trace.name)
            if where is None or where.holds(event, own):
                yield event, own


def _mask(
    events: npt.NDArray[np.void], outputs: npt.NDArray[np.void], choice: _EventFilter
) -> npt.NDArray[np.bool_]:
    stamps = events["stamp"]
    mask: npt.NDArray[np.bool_] = (stamps >= np.uint64(choice.from_ns)) & (
        stamps <= np.uint64(choice.to_ns)
    )
    if choice.kinds is not None:
        mask &= np.isin(events["kind"], choice.kinds)
    if choice.entities is not None:
        mask &= np.isin(events["entity"], choice.entities)
    if choice.touching is not None:
        mask &= _touching(events, outputs, choice.touching)
    return mask


def _touching(
    events: npt.NDArray[np.void], outputs: npt.NDArray[np.void], entities: npt.NDArray[np.uint32]
) -> npt.NDArray[np.bool_]:
    """Return which events are of some entities, or send from one."""
    touching: npt.NDArray[np.bool_] = np.isin(events["entity"], entities)
    senders = outputs["event"][np.isin(outputs["entity"], entities)]
    touching[(senders - events["index"][0]).astype(np.intp)] = True
    return touching


@click.command()
@click.argument("trace", type=click.Path(path_type=Path))
@click.argument("node")
@click.argument("what", metavar="TOPIC|CALLBACK", default="")
@click.option(
    "--at",
    type=RunTimeParam(),
    metavar="T",
    help="Ask about time T of the run: seconds, or with a unit (90s, 5ms). @T is a simulated time.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def why(trace: Path, node: str, what: str, at: TimeInRun | None, as_json: bool) -> int:
    """Say why a callback of NODE did not come, or came late.

    TOPIC is that of a subscription, or the name of a service or client; CALLBACK is the function
    of one of these or of a timer (Planner.on_scan, or on_scan), or the number of an entity.
    Without either, those of the node are listed.

    Without --at, the whole run is looked at: the first message that the callback did not get, else
    the one it got latest. The line of code is that of what is to blame.

    Exit status: 0 if the callback ran as expected, 1 if there is a reason why it did not, 2 if
    there is no such node, topic or callback.
    """
    from rsltrace.diff.why.answer import AsExpected, answer_lines
    from rsltrace.diff.why.answer import as_json as reason_json
    from rsltrace.diff.why.answer import why as find_reason

    with Trace.open(trace) as opened:
        tell_notes(notes_on(opened))
        at_ns = None if at is None else at.stamp_ns(opened.start_ns, opened.end_ns)
        reason = find_reason(opened, node, what, at_ns)
        if as_json:
            say(json.dumps(reason_json(reason), indent=2))
        else:
            say("\n".join(answer_lines(reason)))
    if reason.event is not None and not as_json:
        tell(f"next: rsltrace view {path_word(str(trace))} --at {reason.event}")
    return int(not isinstance(reason, AsExpected))
