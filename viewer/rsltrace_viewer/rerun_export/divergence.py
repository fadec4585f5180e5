"""Of two runs, what differs and why: as a text beside the pictures, and as marks on the timelines.

    divergence            the verdict, the chain of causes, the values that differ, as a text
    divergence/agreement  a lane: the runs agree, then they differ
    divergence/chain      a lane with the events from the root to the divergence

Where an event is in one run only, it is marked where it happened there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace.diff.result.divergence import (
    CallDifference,
    CauseStep,
    Divergence,
    MessageDifference,
    StateDifference,
)
from rsltrace.diff.result.events import EventView
from rsltrace.diff.result.traces import Diff
from rsltrace.model.printable import printable, shortened
from rsltrace.model.stamp import format_duration, format_seconds
from rsltrace_viewer.rerun_export.columns import EVENT, SIM_TIME, Clock, lists, make_chunk
from rsltrace_viewer.rerun_export.paths import join

DOCUMENT = "/divergence"
AGREEMENT = "/divergence/agreement"
CHAIN = "/divergence/chain"
_AGREE, _DIFFER = "the runs agree", "the runs differ"
_GREEN, _RED = 0x4CAF50FF, 0xEF5350FF
_VALUE_WIDTH = 18
_LINE_WIDTH = 50
_FIELDS_MAX = 20


@dataclass(frozen=True, slots=True)
class Marks:
    """What of a diff the layout shows. ``fields`` are (topic, curves) that differ."""

    document: str
    lanes: tuple[str, ...]
    fields: tuple[tuple[str, str], ...]
    topics: tuple[str, ...]
    """Topics that the divergence reaches."""
    stamp_ns: int | None
    """When the runs diverge."""


def marks_of(diff: Diff) -> Marks:
    """Return what the layout needs to know."""
    first = diff.divergences[0] if diff.divergences else None
    here = _either(first.a, first.b) if first is not None else None
    fields: dict[tuple[str, str], None] = {}
    for divergence in diff.divergences:
        for message in divergence.messages:
            for field in message.fields:
                path = field.path.split("[")[0]
                inside = path.rpartition(".")[0] if path == field.path else path
                fields[message.topic, join(inside).strip("/") if inside else ""] = None
    lanes = (AGREEMENT, CHAIN) if diff.divergences else (AGREEMENT,)
    topics = dict.fromkeys(reach.topic for each in diff.divergences for reach in each.reaches)
    stamp_ns = here.stamp_ns if here is not None else None
    return Marks(DOCUMENT, lanes, tuple(fields), tuple(topics), stamp_ns)


def divergence_chunks(diff: Diff, start_ns: int, clock: Clock) -> Iterator[Chunk]:
    """Yield the text and the marks. ``start_ns`` is when the earlier of the runs started."""
    yield from make_chunk(
        DOCUMENT,
        (),
        (
            (rr.TextDocument.descriptor_text(), pa.array([document(diff)])),
            (rr.TextDocument.descriptor_media_type(), pa.array(["text/markdown"])),
        ),
    )
    first = diff.divergences[0] if diff.divergences else None
    yield from _agreement(diff, first, start_ns, clock)
    if first is not None:
        yield from _chain(first, clock)


def _agreement(
    diff: Diff, first: Divergence | None, start_ns: int, clock: Clock
) -> Iterator[Chunk]:
    state = rr.StateChange.descriptor_state()
    here = _either(first.a, first.b) if first is not None else None
    stamps, events, states = [start_ns], [0], [_AGREE]
    if here is not None or not diff.identical:
        end_ns = min(diff.a.end_ns, diff.b.end_ns)
        stamps.append(here.stamp_ns if here is not None else end_ns)
        events.append(here.index if here is not None else diff.agreeing)
        states.append(_DIFFER)
    yield from make_chunk(
        AGREEMENT,
        ((SIM_TIME, clock.array(np.array(stamps))), (EVENT, pa.array(events))),
        ((state, pa.array(states)),),
    )
    two = np.array([2])
    configuration = rr.StateConfiguration
    yield from make_chunk(
        AGREEMENT,
        (),
        (
            (configuration.descriptor_values(), lists(two, pa.array([_AGREE, _DIFFER]))),
            (
                configuration.descriptor_colors(),
                lists(two, pa.array([_GREEN, _RED], type=pa.uint32())),
            ),
        ),
    )


def _chain(first: Divergence, clock: Clock) -> Iterator[Chunk]:
    """Yield the lane of causes: each from its event to the next, the divergence to the end."""
    steps = [(view, step) for step in first.chain if (view := _either(step.a, step.b))]
    rows = [
        (view.index, view.stamp_ns, f"{i + 1}. {printable(_step(s))}")
        for i, (view, s) in enumerate(steps)
    ]
    here = _either(first.a, first.b)
    if here is not None and (not rows or rows[-1][0] != here.index):
        rows.append((here.index, here.stamp_ns, f"divergence: {_event(here)}"))
    if not rows:
        return
    rows.sort()
    rows.append((rows[-1][0] + 1, rows[-1][1] + 1, ""))
    indexes, stamps, texts = zip(*rows, strict=True)
    state = rr.StateChange.descriptor_state()
    yield from make_chunk(CHAIN, ((EVENT, pa.array(indexes)),), ((state, pa.array(texts)),))
    times = clock.array(np.array(stamps[:-1]))
    yield from make_chunk(CHAIN, ((SIM_TIME, times),), ((state, pa.array(texts[:-1])),))


def document(diff: Diff) -> str:
    """Return the diff as Markdown, for people."""
    lines = [
        f"# {'Identical' if diff.identical else _text(diff.verdict.value)}",
        "",
        _text(diff.sentence),
    ]
    lines += ["", "| | a | b |", "|---|---|---|"]
    lines += [
        f"| trace | {_text(diff.a.path)} | {_text(diff.b.path)} |",
        f"| digest | `{diff.a.digest}` | `{diff.b.digest}` |",
        f"| events | {diff.a.events} | {diff.b.events} |",
        f"| end | {format_seconds(diff.a.end_ns)} s | {format_seconds(diff.b.end_ns)} s |",
        "",
        f"The first **{diff.agreeing}** events are the same.",
    ]
    for number, divergence in enumerate(diff.divergences, 1):
        lines += ["", *_divergence(divergence, number, len(diff.divergences))]
    if diff.settings:
        lines += ["", "## Job and environment", "", "| | a | b |", "|---|---|---|"]
        lines += [f"| {_text(str(s))} | {_value(s.a)} | {_value(s.b)} |" for s in diff.settings]
    lines += [f"\n{_text(note)}" for note in diff.notes]
    return "\n".join(lines) + "\n"


def _divergence(divergence: Divergence, number: int, count: int) -> Iterator[str]:
    yield f"## Divergence {number} of {count}" if count > 1 else "## Where they diverge"
    yield ""
    for name, view in (("a", divergence.a), ("b", divergence.b)):
        yield f"- **{name}**: {_text(_event(view)) if view else 'nothing there'}"
    for message in divergence.messages:
        yield ""
        yield from _message(message)
    yield from _beside(divergence)
    if divergence.chain:
        yield ""
        yield "### From the root"
        yield ""
        for place, step in enumerate(divergence.chain, 1):
            yield f"{place}. {_text(_step(step))}"
    if divergence.root_sentence:
        yield ""
        yield _text(divergence.root_sentence)
    if divergence.reaches:
        yield ""
        reached = ", ".join(
            f"{_text(reach.topic)} after {format_duration(reach.after_ns)}"
            for reach in divergence.reaches
        )
        yield f"It reaches {reached}."
    if divergence.next_step:
        yield ""
        yield f"`{printable(divergence.next_step)}`"


def _message(message: MessageDifference) -> Iterator[str]:
    what = "its input" if message.position < 0 else f"output {message.position + 1}"
    yield f"**{_text(message.topic)}** ({_text(message.type)}, {what}): {message.presence}"
    if message.reason:
        yield f" {_text(message.reason)}"
    if message.preview:
        yield f" `{printable(shortened(message.preview, 3 * _VALUE_WIDTH))}`"
    if message.fields:
        yield ""
        yield "```"  # a table would cut off the digits that differ
        for field in message.fields[:_FIELDS_MAX]:
            difference = f"|a-b| {field.absolute:.6g}" if field.absolute is not None else ""
            yield _code(f"{field.path}  {difference} {field.note}".rstrip())
            for name, value in (("a", field.a), ("b", field.b)):
                yield _code(f"  {name}  {'—' if value is None else shortened(value, _LINE_WIDTH)}")
        more = len(message.fields[_FIELDS_MAX:]) + message.more_fields
        if more:
            yield f"{more} more"
        yield "```"


def _beside(divergence: Divergence) -> Iterator[str]:
    """Yield what differs beside the messages: the node's state, answers that came from outside."""
    told: list[tuple[str, str, StateDifference | CallDifference]]
    told = [("State of the node after it", one.path, one) for one in divergence.state]
    told += [
        (f"Call from outside ({_text(call.source)}, at {_text(call.where)})", call.call, call)
        for call in divergence.calls
        if call.a != call.b
    ]
    for number, (title, name, one) in enumerate(told[:_FIELDS_MAX]):
        if not number or told[number - 1][0] != title:
            yield from ("", f"**{title}**", "")
        a, b = ("—" if v is None else shortened(v, _VALUE_WIDTH) for v in (one.a, one.b))
        yield from ("```", _code(f"{name}  {a}  |  {b}"), "```")


def _step(step: CauseStep) -> str:
    view = _either(step.a, step.b)
    side = "" if step.a and step.b else (" (only in a)" if step.a else " (only in b)")
    relation = f", {step.relation}" if step.relation else ""
    return f"{_event(view) if view else 'an event'}{relation}{side}"


def _event(view: EventView) -> str:
    what = f"{view.entity.node or '(run)'} {view.kind.label} {view.entity.name}"
    return printable(f"#{view.index} at {format_seconds(view.stamp_ns)} s: {what}")


def _either(a: EventView | None, b: EventView | None) -> EventView | None:
    return a if a is not None else b


def _text(text: str) -> str:
    """Return a text that Markdown shows as it is, in a table as well."""
    safe = printable(text)
    for character in "\\`*_{}[]<>|#":
        safe = safe.replace(character, f"\\{character}")
    return safe


def _code(text: str) -> str:
    """Return a text as a line of a block of code, which it cannot end."""
    return printable(text).replace("`", "'")


def _value(text: str | None) -> str:
    return "—" if text is None else _text(shortened(text, _VALUE_WIDTH))
