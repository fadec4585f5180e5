"""Of two runs, what differs and why: as a text beside the pictures, and as marks on the timelines.

    divergence            the verdict, the chain of causes, the values that differ, as a text
    divergence/agreement  a lane: the runs agree, then they differ
    divergence/chain      a lane with the events from the root to the divergence

Where an event is in one run only, it is marked where it happened there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace.diff.facts.evidence import CauseStep, EventView, LinkKind
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import report_lines
from rsltrace.diff.report.line import plain_text
from rsltrace.diff.report.markdown import code_block
from rsltrace.diff.result import Diff, Divergence
from rsltrace.diff.sentences.values import link_text
from rsltrace.trace.model.printable import printable
from rsltrace.trace.model.stamp import format_seconds
from rsltrace.trace.words.phrases import event_title
from rsltrace_viewer.rerun_export.colours import lane
from rsltrace_viewer.rerun_export.columns import EVENT, SIM_TIME, Clock, lane_colours, make_chunk
from rsltrace_viewer.rerun_export.paths import join

DOCUMENT = "/divergence"
AGREEMENT = "/divergence/agreement"
CHAIN = "/divergence/chain"
_AGREE, _DIFFER = "the runs agree", "the runs differ"
_GREEN, _RED = 0x4CAF50FF, 0xEF5350FF
_WIDTH = 60
"""Characters of a line in the text panel."""


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
    first = diff.shown
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
    first = diff.shown
    yield from _agreement(diff, first, start_ns, clock)
    if first is not None:
        yield from _chain(first, clock)


def _agreement(
    diff: Diff, first: Divergence | None, start_ns: int, clock: Clock
) -> Iterator[Chunk]:
    state = rr.StateChange.descriptor_state()
    here = _either(first.a, first.b) if first is not None else None
    stamps, events, states = [start_ns], [0], [_AGREE]
    if here is not None or diff.diverged:
        end_ns = min(diff.a.end_ns, diff.b.end_ns)
        stamps.append(here.stamp_ns if here is not None else end_ns)
        events.append(here.index if here is not None else diff.agreeing)
        states.append(_DIFFER)
    yield from make_chunk(
        AGREEMENT,
        ((SIM_TIME, clock.array(np.array(stamps))), (EVENT, pa.array(events))),
        ((state, pa.array(states)),),
    )
    yield from lane_colours(AGREEMENT, {_AGREE: _GREEN, _DIFFER: _RED})


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
    yield from lane_colours(CHAIN, {text: lane(i) for i, text in enumerate(texts[:-1])})


def document(diff: Diff) -> str:
    """Return the report on the diff as Markdown, for a narrow panel.

    The events before a divergence are left out: they are on the timelines.
    """
    divergences = tuple(
        replace(each, before_a=(), before_b=(), same_node_a=(), same_node_b=())
        for each in diff.divergences
    )
    shown = replace(diff, divergences=divergences)
    report = report_lines(shown, DiffOptions(everything=True), width=_WIDTH)
    verdict = "The runs diverge" if diff.diverged else diff.verdict.value
    title = "The runs are identical" if diff.identical else verdict
    return "\n".join((f"# {title}", "", *code_block(plain_text(report)))) + "\n"


def _step(step: CauseStep) -> str:
    view = _either(step.a, step.b)
    side = "" if step.a and step.b else (" (only in a)" if step.a else " (only in b)")
    relation = f", {link_text(step.link)}" if step.link.kind is not LinkKind.NOTHING else ""
    return f"{_event(view) if view else 'an event'}{relation}{side}"


def _event(view: EventView) -> str:
    when = f"#{view.index} at {format_seconds(view.stamp_ns)} s"
    return f"{when}: {event_title(view.kind, view.entity)}"


def _either(a: EventView | None, b: EventView | None) -> EventView | None:
    return a if a is not None else b
