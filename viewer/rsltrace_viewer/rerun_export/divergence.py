"""Of two runs, what differs and why: as a text beside the pictures, and as marks on the timelines.

    divergence            the verdict, the chain of causes, the values that differ, as a text
    divergence/agreement  a lane: the runs agree, then they differ
    divergence/chain      a lane with the events from the root to the divergence

Where an event is in one run only, it is marked where it happened there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace.diff.alignment.aligned_rows import AlignedRows
from rsltrace.diff.facts.evidence import CauseLinkKind, CauseStep, EventSummary
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import report_lines
from rsltrace.diff.report.line import plain_text
from rsltrace.diff.report.markdown import code_block
from rsltrace.diff.result import Diff, Divergence
from rsltrace.diff.row_sign import RowSign
from rsltrace.diff.sentences.values import link_text
from rsltrace.diff.traces.aligned_runs import AlignedRuns
from rsltrace.trace.model.texts import format_seconds, printable
from rsltrace.trace.words.phrases import event_title
from rsltrace_viewer.rerun_export.columns import (
    ROW,
    SIM_TIME,
    Clock,
    lane,
    lane_colours,
    lists,
    make_chunk,
)
from rsltrace_viewer.rerun_export.messages.chunks import Points
from rsltrace_viewer.rerun_export.moments import join
from rsltrace_viewer.rerun_export.run import Shown

# How far two runs are apart: for each set of curves that differs, the distance over time.
#
#     divergence/distance/TOPIC/FIELD    |a-b|, of the last values of both at that moment
#
# What is a curve in one run only, or has another number of values there, differs without a
# distance.

Key: TypeAlias = tuple[str, str]
"""Topic, and where in its messages the curves are."""

_Ints: TypeAlias = npt.NDArray[np.int64]
_Floats: TypeAlias = npt.NDArray[np.float64]


@dataclass(slots=True)
class Distances:
    """Which curves of two runs are equal; for those that are not, the path of their distance."""

    equal: set[Key] = field(default_factory=set)
    paths: dict[Key, str] = field(default_factory=dict)


def curve_keys(run: Shown) -> dict[Key, str]:
    """Return the paths of a run's curves, by what is the same in another run."""
    keys: dict[Key, str] = {}
    for path in run.seen.curves:
        topic = run.seen.topic_of.get(path, "")
        keys[topic, path[len(run.paths.topic(topic)) :].strip("/") if topic else path] = path
    return keys


def distance_chunks(
    shown: Sequence[Shown], clocks: Sequence[Clock], found: Distances
) -> Iterator[Chunk]:
    """Yield the distances between two runs, and note in ``found`` what there is."""
    ours, theirs = (curve_keys(run) for run in shown)
    for key in ours.keys() & theirs.keys():
        a = _joined(shown[0].seen.points.get(ours[key], []))
        b = _joined(shown[1].seen.points.get(theirs[key], []))
        if a is None or b is None or a[2].shape[1] != b[2].shape[1]:
            continue
        if np.array_equal(a[0], b[0]) and np.array_equal(a[2], b[2], equal_nan=True):
            found.equal.add(key)
            continue
        # What counts is the row, where events of both runs stand.
        a, b = (
            (stamps, clock.places(events), values)
            for clock, (stamps, events, values) in zip(clocks, (a, b), strict=True)
        )
        stamps, rows, distances = _distance(a, b)
        if not len(stamps):
            continue
        path = found.paths[key] = join("divergence", "distance", *key)
        times = ((SIM_TIME, clocks[0].array(stamps)), (ROW, pa.array(rows)))
        column = lists(np.ones(len(distances), dtype=np.int64), pa.array(distances))
        yield from make_chunk(path, times, ((rr.Scalars.descriptor_scalars(), column),))
        name = pa.array([[f"|a-b| {key[0]} {key[1]}".strip()]])
        yield from make_chunk(path, (), ((rr.SeriesLines.descriptor_names(), name),))


def _joined(points: list[Points]) -> tuple[_Ints, _Ints, _Floats] | None:
    """Return stamps and events, shape (n,), and values, shape (n, k), in order of time; None if
    there are none, or not as many in each message."""
    rows = [np.asarray(part.value_lengths()) for _, _, part in points]
    counts = np.concatenate(rows) if rows else np.zeros(0)
    if not len(counts) or not counts[0] or (counts != counts[0]).any():
        return None
    stamps, events = (np.concatenate([each[i] for each in points]) for i in (0, 1))
    flat = np.concatenate([part.flatten().to_numpy(zero_copy_only=False) for *_, part in points])
    order = np.argsort(stamps, kind="stable")
    values = flat.astype(np.float64).reshape(len(stamps), -1)
    return stamps[order], events[order], values[order]


def _distance(
    a: tuple[_Ints, _Ints, _Floats], b: tuple[_Ints, _Ints, _Floats]
) -> tuple[_Ints, _Ints, _Floats]:
    """Return stamps, rows and distances wherever one of the runs has a new value."""
    stamps = np.union1d(a[0], b[0])
    stamps = stamps[stamps >= max(a[0][0], b[0][0])]
    last_a, last_b = (np.searchsorted(each[0], stamps, "right") - 1 for each in (a, b))
    rows = np.maximum.accumulate(
        np.where(a[0][last_a] == stamps, a[1][last_a], b[1][last_b])
    )  # those of equal times may stand the other way round
    with np.errstate(invalid="ignore", over="ignore"):
        distances = np.sqrt(np.sum((a[2][last_a] - b[2][last_b]) ** 2, axis=1))
    return stamps, rows, distances


DOCUMENT = "/divergence"
AGREEMENT = "/divergence/agreement"
CHAIN = "/divergence/chain"
_AGREE, _DIFFER = "the runs agree", "the runs differ"
_GREEN, _RED = 0x4CAF50FF, 0xEF5350FF
_SIGNS = {
    RowSign.MATCH: _AGREE,
    RowSign.DIFFERS: _DIFFER,
    RowSign.ONLY_A: "only in a",
    RowSign.ONLY_B: "only in b",
    RowSign.MOVED: "moved",
    RowSign.UNKNOWN: "not compared",
}
_SIGN_COLOURS = dict(
    zip(
        _SIGNS.values(),
        (_GREEN, _RED, 0x4FA3FFFF, 0xFF9D3BFF, 0xFFCA28FF, 0x757575FF),
        strict=True,
    )
)
_WIDTH = 60
"""Characters of a line in the text panel."""


@dataclass(frozen=True, slots=True)
class DivergenceMarks:
    """What of a diff the layout shows. ``fields`` are (topic, curves) that differ."""

    document: str
    lanes: tuple[str, ...]
    fields: tuple[tuple[str, str], ...]
    topics: tuple[str, ...]
    """Topics that the divergence reaches."""
    stamp_ns: int | None
    """When the runs diverge."""
    row: int | None
    """In which row."""


def marks_of(diff: Diff, runs: AlignedRuns) -> DivergenceMarks:
    """Return what the layout needs to know."""
    here, row = _divergence(diff, runs)
    fields: dict[tuple[str, str], None] = {}
    for divergence in diff.divergences:
        for message in divergence.messages:
            for one in message.fields:
                path = one.path.split("[")[0]
                inside = path.rpartition(".")[0] if path == one.path else path
                fields[message.topic, join(inside).strip("/") if inside else ""] = None
    lanes = (AGREEMENT, CHAIN) if diff.divergences else (AGREEMENT,)
    topics = dict.fromkeys(reach.topic for each in diff.divergences for reach in each.reaches)
    stamp_ns = here.stamp_ns if here is not None else None
    return DivergenceMarks(DOCUMENT, lanes, tuple(fields), tuple(topics), stamp_ns, row)


def _divergence(diff: Diff, runs: AlignedRuns) -> tuple[EventSummary | None, int | None]:
    """Return the event at which the runs diverge, that of the earlier row, and its row."""
    first = diff.shown
    sides = () if first is None else ((first.a, False), (first.b, True))
    found = [
        (runs.rows.place_of(view.index, of_b=of_b), view)
        for view, of_b in sides
        if view is not None
    ]
    if not found:
        return None, runs.first_place
    row, here = min(found, key=lambda one: one[0])
    return here, row


def divergence_chunks(
    diff: Diff, runs: AlignedRuns, start_ns: int, clock: Clock
) -> Iterator[Chunk]:
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
    yield from _agreement(diff, runs, start_ns, clock)
    if first is not None:
        yield from _chain(first, runs.rows, clock)


def _agreement(diff: Diff, runs: AlignedRuns, start_ns: int, clock: Clock) -> Iterator[Chunk]:
    """Yield the lane of agreement: by time up to the divergence, by row what each row is."""
    state = rr.StateChange.descriptor_state()
    here, _ = _divergence(diff, runs)
    stamps, states = [start_ns], [_AGREE]
    if here is not None or diff.diverged:
        stamps.append(here.stamp_ns if here is not None else min(diff.a.end_ns, diff.b.end_ns))
        states.append(_DIFFER)
    times = clock.array(np.array(stamps))
    yield from make_chunk(AGREEMENT, ((SIM_TIME, times),), ((state, pa.array(states)),))
    places, signs = runs.rows.sign_changes()
    by_row = [_SIGNS[sign] for sign in signs]
    yield from make_chunk(AGREEMENT, ((ROW, pa.array(places)),), ((state, pa.array(by_row)),))
    yield from lane_colours(AGREEMENT, _SIGN_COLOURS)


def _chain(first: Divergence, aligned: AlignedRows, clock: Clock) -> Iterator[Chunk]:
    """Yield the lane of causes: each from its event to the next, the divergence to the end."""

    def place(a: EventSummary | None, b: EventSummary | None) -> int:
        view = _either(a, b)
        return 0 if view is None else aligned.place_of(view.index, of_b=a is None)

    steps = [(view, step) for step in first.chain if (view := _either(step.a, step.b))]
    rows = [
        (place(s.a, s.b), int(view.stamp_ns), f"{i + 1}. {printable(_step(s))}")
        for i, (view, s) in enumerate(steps)
    ]
    here = _either(first.a, first.b)
    at = place(first.a, first.b)
    if here is not None and (not rows or rows[-1][0] != at):
        rows.append((at, int(here.stamp_ns), f"divergence: {_event(here)}"))
    if not rows:
        return
    rows.sort()
    rows.append((rows[-1][0] + 1, rows[-1][1] + 1, ""))
    places, stamps, texts = zip(*rows, strict=True)
    state = rr.StateChange.descriptor_state()
    yield from make_chunk(CHAIN, ((ROW, pa.array(places)),), ((state, pa.array(texts)),))
    times = clock.array(np.array(stamps[:-1]))
    yield from make_chunk(CHAIN, ((SIM_TIME, times),), ((state, pa.array(texts[:-1])),))
    yield from lane_colours(CHAIN, {text: lane(i) for i, text in enumerate(texts[:-1])})


def document(diff: Diff) -> str:
    """Return the report on the diff as Markdown, for a narrow panel.

    The events before a divergence are left out: they are on the timelines.
    """
    divergences = tuple(replace(each, rows=(), node_rows=()) for each in diff.divergences)
    shown = replace(diff, divergences=divergences)
    report = report_lines(shown, DiffOptions(everything=True), width=_WIDTH)
    verdict = "The runs diverge" if diff.diverged else diff.verdict.value
    title = "The runs are identical" if diff.identical else verdict
    return "\n".join((f"# {title}", "", *code_block(plain_text(report)))) + "\n"


def _step(step: CauseStep) -> str:
    view = _either(step.a, step.b)
    side = "" if step.a and step.b else (" (only in a)" if step.a else " (only in b)")
    relation = f", {link_text(step.link)}" if step.link.kind is not CauseLinkKind.NOTHING else ""
    return f"{_event(view) if view else 'an event'}{relation}{side}"


def _event(view: EventSummary) -> str:
    when = f"#{view.index} at {format_seconds(view.stamp_ns)} s"
    return f"{when}: {event_title(view.kind, view.entity)}"


def _either(a: EventSummary | None, b: EventSummary | None) -> EventSummary | None:
    return a if a is not None else b
