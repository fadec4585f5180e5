"""Everything about one event, as lines: its input and outputs decoded, its cause, its effects.

Messages are decoded when their section is open; nothing else of the trace is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from rsltrace.errors import TraceError
from rsltrace.trace.format import TOPIC_STATES
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import (
    NO_EVENT,
    NO_SEQUENCE,
    EventFlag,
    EventKind,
    EventRecord,
    Output,
    OutputKind,
)
from rsltrace.trace.model.operation import PARAMETER_EVENTS
from rsltrace.trace.model.texts import format_duration, format_seconds, printable, shortened
from rsltrace.trace.states import StateValue, state_after
from rsltrace.trace.words.code import output_places, places_text
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace.trace.words.logs import LEVEL_WARN, log_record
from rsltrace_viewer.model.inspector.effects import Effects
from rsltrace_viewer.model.inspector.message_tree import (
    Line,
    Openness,
    Role,
    bytes_lines,
    message_lines,
    preview,
)
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.events import entity_of, event_text, node_of, outputs_text

# Parameters of a node at some time, put together from what it announced on /parameter_events.

_VALUE_FIELDS = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    5: "byte_array_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}
_MESSAGES_MAX = 20_000
"""So many announcements are read; a node that sets parameters in a loop has more."""


def parameters_at(run: Run, node: str, stamp_ns: int) -> dict[str, object]:
    """Return the parameters of ``node`` at ``stamp_ns``, by name. Raises TraceError."""
    values: dict[str, object] = {}
    for stamp, owner, changes in _announced(run):
        if stamp > stamp_ns:
            break
        if owner == node:
            for name, value in changes:
                if value is None:
                    values.pop(name, None)
                else:
                    values[name] = value
    return dict(sorted(values.items()))


@lru_cache(maxsize=4)
def _announced(run: Run) -> tuple[tuple[int, str, tuple[tuple[str, object], ...]], ...]:
    """Return (stamp, node, changes) of all announcements; a value of None was undeclared."""
    found = []
    for stamp_ns, sequence, data in run.trace.messages(PARAMETER_EVENTS):
        if sequence >= _MESSAGES_MAX:
            break
        message: Any = run.trace.decode(PARAMETER_EVENTS, data)
        changes: list[tuple[str, object]] = [
            (parameter.name, _value(parameter.value))
            for parameter in (*message.new_parameters, *message.changed_parameters)
        ]
        changes += [(parameter.name, None) for parameter in message.deleted_parameters]
        found.append((stamp_ns, message.node, tuple(changes)))
    return tuple(found)


def _value(value: Any) -> object:
    return getattr(value, _VALUE_FIELDS.get(value.type, ""), "not set")


# A node's recorded state as lines.
#
# States are made of the changes up to an event, so one is put together only where somebody looks.

_VALUE_MAX = 200
_ELEMENTS_SHOWN = 8


def state_lines(run: Run, event: EventRecord, openness: Openness) -> Iterator[Line]:
    """Yield the attributes of the event's node after it; nothing if they were not recorded."""
    if not event.state_hash or not _has_states(run):
        return
    entity = run.entities[event.entity]
    node = entity.id if entity.kind is EntityKind.NODE else entity.node
    is_open = openness.is_open("state", False)
    title = f"of {run.node_name(event.entity)} after this event"
    yield Line(0, "state", title, Role.SECTION, "state", is_open)
    if not is_open:
        return
    try:
        state = state_after(run.trace, node, event.index)
    except TraceError as error:
        yield Line(1, "", printable(str(error)), Role.ERROR, "state.error")
        return
    for path, leaf in state.items():
        yield Line(1, printable(path), _shown(leaf), Role.FIELD, f"state.{path}")
    if not state:
        yield Line(1, "", "no attributes", Role.NOTE, "state.none")


def _has_states(run: Run) -> bool:
    return any(channel.topic == TOPIC_STATES for channel in run.trace.channels.values())


def _shown(leaf: StateValue) -> str:
    if not isinstance(leaf, np.ndarray):
        return shortened(printable(leaf), _VALUE_MAX)
    first = ", ".join(repr(value.item()) for value in leaf.flat[:_ELEMENTS_SHOWN])
    more = ", …" if leaf.size > _ELEMENTS_SHOWN else ""
    shape = " x ".join(map(str, leaf.shape)) or "scalar"
    return f"{leaf.dtype} {shape}: [{first}{more}]"


_MESSAGES = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)
_OUTPUTS_OPEN = 3
"""More outputs than this are listed closed: a constructor has dozens."""
_ANSWER_MAX = 200
_EFFECTS_SHOWN = 12
"""Longer lists are in the choice that ``e`` offers."""


def inspect(run: Run, index: int, openness: Openness, effects: Effects | None = None) -> list[Line]:
    """Return the lines for event ``index``. Raises IndexError; damage becomes a line."""
    try:
        event = run.event(index)
        outputs = run.outputs(index)
    except TraceError as error:
        return [Line(0, "", printable(str(error)), Role.ERROR, "error")]
    lines = [*_title_lines(run, event, outputs), *_cause_lines(run, event, effects)]
    for make in (_input_lines, _output_lines, _finding_lines):
        try:
            lines += make(run, event, outputs, openness)
        except TraceError as error:
            lines.append(Line(0, "", printable(str(error)), Role.ERROR, f"error.{make.__name__}"))
    lines += _parameter_lines(run, event, openness)
    lines += state_lines(run, event, openness)
    lines += _detail_lines(run, event, openness)
    return lines


def _title_lines(run: Run, event: EventRecord, outputs: list[Output]) -> Iterator[Line]:
    entity = entity_of(run, event) or event.kind.label
    title = f"{node_of(run, event)}  {event.kind.label} {entity}"
    yield Line(0, f"event {event.index}", title, Role.SECTION, "event")
    at = f"{format_seconds(event.stamp_ns - run.base_ns)} s"
    yield Line(1, "at", at, Role.FIELD, "event.at")
    if EventFlag.RAISED in event.flags:
        raised = next((o for o in outputs if o.kind is OutputKind.EXCEPTION), None)
        what = run.words.output(raised).partition(" ")[2] if raised is not None else ""
        yield Line(1, "!", f"raised {what or 'an exception'}", Role.ERROR, "event.raised")
    if EventFlag.SUSPENDED in event.flags:
        yield Line(1, "…", "waits: it will be resumed", Role.NOTE, "event.suspended")


def _input_lines(
    run: Run, event: EventRecord, outputs: list[Output], openness: Openness
) -> Iterator[Line]:
    is_open = openness.is_open("in", True)
    source = run.input_of(event)
    if source is not None and source.kind is OutputKind.TASK:
        source = _handed_on(run, event) or source
    if source is None:
        yield Line(0, "input", _plain_input(event), Role.SECTION, "in")
        return
    if source.kind not in _MESSAGES and source.sequence == NO_SEQUENCE:  # nothing to be recorded
        yield Line(0, "input", _channel_text(run, source), Role.SECTION, "in")
        return
    yield Line(0, "input", _channel_text(run, source), Role.SECTION, "in", is_open)
    if is_open:
        yield from content_lines(run, source, "in", 1, openness)


def _handed_on(run: Run, event: EventRecord) -> Output | None:
    """Return the message that a task was given by the event that made it (an action's goal)."""
    maker = run.event(event.cause_event)
    same = event.input_hash and maker.input_hash == event.input_hash
    return run.input_of(maker) if same else None


def _plain_input(event: EventRecord) -> str:
    if event.kind is EventKind.TIMER:
        return "none (a timer's deadline)"
    if event.kind is EventKind.CONSTRUCT:
        return "none (the node was constructed)"
    return f"hash {event.input_hash:016x}, from outside of the run" if event.input_hash else "none"


def _output_lines(
    run: Run, event: EventRecord, outputs: list[Output], openness: Openness
) -> Iterator[Line]:
    if not outputs:
        yield Line(0, "outputs", "none", Role.SECTION, "out")
        return
    is_open = openness.is_open("out", True)
    summary = str(len(outputs))
    yield Line(0, "outputs", summary, Role.SECTION, "out", is_open)
    if not is_open:
        return
    for place, output in enumerate(outputs):
        path = f"out.{place}"
        role = _output_role(run, output)
        inside = output.kind in _MESSAGES or (
            output.sequence != NO_SEQUENCE and output.kind is not OutputKind.LOG
        )
        small = len(outputs) <= _OUTPUTS_OPEN
        opened = openness.is_open(path, small) if inside else None
        yield Line(1, str(place), _output_title(run, output), role, path, opened)
        if opened:
            yield from content_lines(run, output, path, 2, openness)


def _finding_lines(
    run: Run, event: EventRecord, outputs: list[Output], openness: Openness
) -> Iterator[Line]:
    """What the guard found in the event; nothing for nearly all events."""
    found = run.trace.findings.get(event.index, [])
    if not found:
        return
    is_open = openness.is_open("guard", True)
    yield Line(0, "calls from outside", str(len(found)), Role.SECTION, "guard", is_open)
    if not is_open:
        return
    for place, finding in enumerate(found):
        value = shortened(printable(finding.value), _ANSWER_MAX)
        text = f"{printable(finding.call)} -> {value}"
        yield Line(1, finding.source.value, text, Role.WARNING, f"guard.{place}")
        for number, frame in enumerate(finding.stack.splitlines()):
            path = f"guard.{place}.{number}"
            yield Line(2, "at", printable(frame), Role.NOTE, path)


def _output_title(run: Run, output: Output) -> str:
    text = _channel_text(run, output) if output.kind in _MESSAGES else run.words.output(output)
    places = printable(places_text(output_places(run.trace, output)))
    return f"{text}  at {places}" if places else text


def _output_role(run: Run, output: Output) -> Role:
    if output.kind is OutputKind.EXCEPTION:
        return Role.ERROR
    if output.kind is OutputKind.LOG:
        record = log_record(run.trace, output)
        return Role.WARNING if record is not None and record.level >= LEVEL_WARN else Role.FIELD
    return Role.FIELD


def _channel_text(run: Run, output: Output) -> str:
    entity = run.entities.get(output.entity)
    kind = printable(entity.type) if entity is not None else ""
    return f"{run.words.output(output)}  {kind}".rstrip()


def content_lines(
    run: Run, output: Output, path: str, depth: int, openness: Openness
) -> Iterator[Line]:
    """Yield the decoded payload of an output; where that fails, the reason and the bytes."""
    if output.sequence == NO_SEQUENCE:
        text = f"not recorded (hash {output.hash:016x}); record: in the job says what is"
        yield Line(depth, "", text, Role.NOTE, f"{path}.absent")
        return
    data = b""
    try:
        found = run.trace.payload(output)
        channel = run.trace.channel_of(output)
        if found is None or channel is None:
            yield Line(depth, "", "its channel is not in the trace", Role.NOTE, f"{path}.absent")
            return
        data = found[2]
        detail = run.trace.detail(output)
        if detail is not None:
            for number, text in enumerate(detail.rstrip("\n").split("\n")):
                yield Line(depth, "", printable(text), Role.FIELD, f"{path}.text{number}")
            return
        message = run.trace.decode(channel, data)
    except TraceError as error:
        yield Line(depth, "", printable(str(error)), Role.ERROR, f"{path}.error")
        yield from bytes_lines(data, path, depth)
        return
    yield from message_lines(message, path, depth, openness)


def _cause_lines(run: Run, event: EventRecord, effects: Effects | None) -> Iterator[Line]:
    if event.cause_event == NO_EVENT:
        waited = event.kind is EventKind.RESUME
        text = "no other event: its wait was over" if waited else "no other event"
        yield Line(0, "cause", text, Role.SECTION, "cause")
    else:
        yield Line(0, "cause", "", Role.SECTION, "cause")
        yield event_link(run, event.cause_event, "cause.event", since_ns=event.stamp_ns)
    if effects is None or effects.event != event.index:
        yield Line(0, "effects", "…", Role.SECTION, "effects")
        return
    if effects.done:
        whole = run.trace.complete and effects.searched == run.count - 1
        none = "none" if whole else f"none up to event {effects.searched}"
        text = str(len(effects.found)) if effects.found else none
    else:
        text = f"{len(effects.found)} so far, looking at event {effects.searched} …"
    yield Line(0, "effects", text, Role.SECTION, "effects")
    for place, index in enumerate(effects.found[:_EFFECTS_SHOWN]):
        yield event_link(run, index, f"effects.{place}", since_ns=event.stamp_ns)
    if len(effects.found) > _EFFECTS_SHOWN:
        more = f"… and {len(effects.found) - _EFFECTS_SHOWN} more"
        yield Line(1, "", more, Role.NOTE, "effects.more")


def event_link(run: Run, index: int, path: str, since_ns: int | None = None) -> Line:
    """Return a line that leads to an event: ``→ 17  /ekf sub /odom  +0.2 ms``."""
    try:
        other = run.event(index)
    except (TraceError, IndexError) as error:
        return Line(1, "→", printable(f"{index} ({error})"), Role.ERROR, path)
    text = event_text(run, other)
    if since_ns is not None and other.stamp_ns != since_ns:
        sign = "+" if other.stamp_ns > since_ns else "-"
        text += f"  {sign}{format_duration(abs(other.stamp_ns - since_ns))}"
    return Line(1, "→", text.rstrip(), Role.LINK, path, link=index)


def _parameter_lines(run: Run, event: EventRecord, openness: Openness) -> Iterator[Line]:
    node = node_of(run, event)
    entity = run.entities.get(event.entity)
    if entity is None or entity.kind is EntityKind.SYSTEM or node == RUN_NAME:
        return
    is_open = openness.is_open("parameters", False)
    yield Line(0, "parameters", f"of {node} now", Role.SECTION, "parameters", is_open)
    if not is_open:
        return
    try:
        values = parameters_at(run, node, event.stamp_ns)
    except TraceError as error:
        yield Line(1, "", printable(str(error)), Role.ERROR, "parameters.error")
        return
    if not values:
        yield Line(1, "", "none known", Role.NOTE, "parameters.none")
    for name, value in values.items():
        path = f"parameters.{name}"
        yield Line(1, printable(name), preview(value), Role.FIELD, path)


def _detail_lines(run: Run, event: EventRecord, openness: Openness) -> Iterator[Line]:
    is_open = openness.is_open("details", False)
    yield Line(0, "details", "timing, hashes, entity", Role.SECTION, "details", is_open)
    if not is_open:
        return
    for label, text in _details(run, event):
        yield Line(1, label, printable(text), Role.FIELD, f"details.{label}")


def _details(run: Run, event: EventRecord) -> Sequence[tuple[str, str]]:
    rows = [("since start", format_duration(event.stamp_ns - run.base_ns))]
    if run.base_ns:
        rows.append(("simulated time", f"{format_seconds(event.stamp_ns)} s"))
    if event.index:
        before = event.stamp_ns - run.stamp(event.index - 1)
        rows.append(("since the event before", format_duration(before)))
    if 0 <= event.cause_event < run.count:
        cause = event.stamp_ns - run.stamp(event.cause_event)
        rows.append(("since its cause", format_duration(cause)))
    rows += [
        ("input hash", f"{event.input_hash:016x}"),
        ("output hash", f"{event.output_hash:016x}"),
        ("chain hash", f"{event.chain_hash:016x}"),
    ]
    if event.state_hash:
        rows.append(("state hash", f"{event.state_hash:016x}"))
    entity = run.entities.get(event.entity)
    if entity is not None and entity.id:
        rows += _entity_details(run, entity)
    return rows


def _entity_details(run: Run, entity: Entity) -> list[tuple[str, str]]:
    rows = [("entity", f"#{entity.id} {entity.kind.label} {entity.name}")]
    if entity.type:
        rows.append(("type", entity.type))
    rows.append(("created", f"{format_seconds(entity.created_ns - run.base_ns)} s"))
    for key, value in entity.detail.items():
        if key == "period_ns" and isinstance(value, int):
            rows.append(("period", format_duration(value)))
        elif isinstance(value, dict):
            rows += [(f"{key} {inner}", str(text)) for inner, text in value.items()]
        else:
            rows.append((key, str(value)))
    return rows


def summary_line(run: Run, index: int) -> str:
    """Return an event as one line, for lists: what it is and what it did."""
    event = run.event(index)
    did = outputs_text(run, run.outputs(index), 60)
    return f"{event_text(run, event)}  {did}".rstrip()
