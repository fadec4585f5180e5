"""Numbers over time: fields of messages, rates, latencies, thinned out to what a plot can show."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.measure import measuring
from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import NO_EVENT, OutputKind
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.model.texts import PLACEHOLDERS, counted
from rsltrace_viewer.model.chains import ARROW, VIA
from rsltrace_viewer.model.run import Run

SAMPLES_MAX = 1500
"""Messages decoded for a plot; of more, every n-th is taken, and the plot says so."""

TELLING_MAX = 16
"""Messages of a topic that are read to choose the field to plot first."""

_RATE_BINS = 240
_NUMBERS_MAX = 16
"""Items of an array that are offered one by one."""


CHAIN_LATENCY, CHAIN_AGE = "chain latency", "data age at the end"
_MEASURES = {CHAIN_LATENCY: "latency", CHAIN_AGE: "age"}
_UNITS = {"rate": "Hz", "latency": "ms", CHAIN_LATENCY: "ms", CHAIN_AGE: "ms"}


@dataclass(frozen=True, slots=True)
class PlotSource:
    """Something that can be plotted. ``field`` is ``pose.position.x`` or empty."""

    kind: str
    name: str
    field: str = ""

    @property
    def label(self) -> str:
        if self.kind == "field":
            return f"{self.name}  {self.field}"
        return f"{self.kind} of {self.name}"

    @property
    def unit(self) -> str:
        """The unit of the values, where it is known."""
        return _UNITS.get(self.kind, "")


@dataclass(frozen=True, slots=True)
class Series:
    """Points of one run: times in s and values, shape (n,); ``note`` says what was left out."""

    times: npt.NDArray[np.float64]
    values: npt.NDArray[np.float64]
    note: str = ""


_NO_POINTS: npt.NDArray[np.float64] = np.zeros(0)


def sources_of(run: Run) -> list[PlotSource]:
    """Return rates and latencies of a run; fields of a topic come from ``fields_of``."""
    found = []
    counts = run.trace.message_counts
    sent = {c.topic for c in run.trace.channels.values() if counts.get(c.id)}
    for entity in _publishers(run):
        if entity.name in sent and entity.name not in NODE_TOPICS:
            found.append(PlotSource("rate", entity.name))
    for entity in run.entities.values():
        if entity.kind is EntityKind.SUBSCRIPTION and entity.name in {e.name for e in found}:
            found.append(PlotSource("latency", f"{entity.name} → {run.node_name(entity.id)}"))
    return found


def topics_with_messages(run: Run) -> list[str]:
    """Return the topics that have recorded messages, in the order of their publishers."""
    counts = run.trace.message_counts
    topics = [
        channel.topic
        for channel in run.trace.channels.values()
        if counts.get(channel.id) and not channel.topic.startswith("/rsltrace/")
    ]
    # What every node has comes last: one rarely looks for it.
    return sorted(dict.fromkeys(topics), key=lambda topic: topic in NODE_TOPICS)


def fields_of(run: Run, topic: str) -> list[PlotSource]:
    """Return the numeric fields of a topic, as its first message has them. Raises TraceError."""
    for _, _, data in run.trace.messages(topic):
        message = run.trace.decode(topic, data)
        return [PlotSource("field", topic, path) for path in numeric_paths(message)]
    return []


def series_of(run: Run, source: PlotSource) -> Iterator[Series]:
    """Yield a series as it becomes known, the last one whole. Raises TraceError."""
    if source.kind == "field":
        yield from _field_series(run, source)
    elif source.kind == "rate":
        yield from _rate_series(run, source.name)
    elif source.kind in _MEASURES:
        yield from _chain_series(run, source.name, _MEASURES[source.kind])
    else:
        topic, _, node = source.name.partition(" → ")
        yield from _latency_series(run, topic, node)


def _publishers(run: Run) -> list[Entity]:
    seen: dict[str, Entity] = {}
    for entity in run.entities.values():
        if entity.kind is EntityKind.PUBLISHER:
            seen.setdefault(entity.name, entity)
    return list(seen.values())


def numeric_paths(value: Any, path: str = "") -> Iterator[str]:
    """Yield the paths of the numbers in a decoded message: ``pose.position.x``, ``ranges[3]``."""
    if isinstance(value, (bool, int, float)):
        yield path
    elif isinstance(value, np.ndarray):
        for place in range(min(len(value), _NUMBERS_MAX)):
            yield f"{path}[{place}]"
    elif isinstance(value, list):
        for place in range(min(len(value), 4)):
            yield from numeric_paths(value[place], f"{path}[{place}]")
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name not in PLACEHOLDERS:
                inner = f"{path}.{field.name}" if path else field.name
                yield from numeric_paths(getattr(value, field.name), inner)


def most_telling(fields: Sequence[PlotSource], messages: Sequence[Sequence[object]]) -> PlotSource:
    """Return the field of a topic to plot first, given some of its messages in each run.

    A field that differs between the runs comes before one that varies, and that before constants;
    then a position or a velocity before others."""
    values = np.array(
        [[[_number_at(one, f.field) for f in fields] for one in run] for run in messages if run]
        or [[[0.0] * len(fields)]]
    )
    differs = (values != values[:1]).any(axis=(0, 1))
    varies = (values != values[:, :1]).any(axis=(0, 1))

    def rank(place: int) -> tuple[bool, bool, bool, int, bool, int]:
        field = fields[place].field
        likely = next((n for n, word in enumerate(_LIKELY) if field.endswith(word)), len(_LIKELY))
        return (
            "stamp" in field,
            not differs[place],
            not varies[place],
            likely,
            "[" in field,
            place,
        )

    return fields[min(range(len(fields)), key=rank)]


_LIKELY = ("position.x", "linear.x", "linear_acceleration.x", "latitude", "data", "value")


def _number_at(message: object, path: str) -> float:
    try:
        found = value_at(message, path)
    except (AttributeError, TypeError, ValueError):
        return 0.0
    return found if np.isfinite(found) else 0.0


def value_at(message: Any, path: str) -> float:
    """Return a number by its path; NaN where an array is shorter."""
    value = message
    for part in path.replace("[", ".[").split("."):
        if part.startswith("["):
            place = int(part[1:-1])
            if place >= len(value):
                return float("nan")
            value = value[place]
        elif part:
            value = getattr(value, part)
    return float(value)


def channel_of(run: Run, topic: str) -> ChannelInfo | None:
    """Return the channel with the messages of a topic; None if there is none."""
    channels = run.trace.channels.values()
    counts = run.trace.message_counts
    return next((c for c in channels if c.topic == topic and counts.get(c.id)), None)


def _field_series(run: Run, source: PlotSource) -> Iterator[Series]:
    trace = run.trace
    channel = channel_of(run, source.name)
    if channel is None:
        return
    count = trace.message_counts.get(channel.id, 0)
    step = max(-(-count // SAMPLES_MAX), 1)
    note = f"one in {step} of {count:,} messages" if step > 1 else counted(count, "message")
    times, values = [], []
    for sequence in range(0, count, step):
        stamp_ns, data = trace.message(channel.id, sequence)
        times.append(stamp_ns / 1e9)
        values.append(value_at(trace.decode(channel, data), source.field))
        if len(times) % 100 == 0:
            yield Series(np.array(times), np.array(values), f"{note}, {sequence / count:.0%} read")
    yield Series(np.array(times), np.array(values), note)


def _rate_series(run: Run, topic: str) -> Iterator[Series]:
    ids = np.array([e.id for e in _publishers_of(run, topic)], dtype=np.uint32)
    start, end = run.start_ns, run.end_ns + 1
    counts = np.zeros(_RATE_BINS)
    width_s = (end - start) / _RATE_BINS / 1e9
    times = np.asarray(start / 1e9 + (np.arange(_RATE_BINS) + 0.5) * width_s, dtype=np.float64)
    for number in range(len(run.segments)):
        try:
            segment = run.segment(number)
            outputs = run.segment_outputs(number)
        except TraceError:
            continue
        own = outputs[np.isin(outputs["entity"], ids) & (outputs["kind"] == OutputKind.MESSAGE)]
        events = (own["event"] - np.uint64(segment.first)).astype(np.intp)
        stamps = segment.events["stamp"][events].astype(np.float64)
        places = ((stamps - start) / (end - start) * _RATE_BINS).astype(np.int64)
        counts += np.bincount(places, minlength=_RATE_BINS)[:_RATE_BINS]
        yield Series(times, counts / width_s, f"{(number + 1) / len(run.segments):.0%} read")
    yield Series(times, counts / width_s, f"in steps of {width_s:.3g} s")


def _publishers_of(run: Run, topic: str) -> list[Entity]:
    return [e for e in run.entities.values() if e.kind is EntityKind.PUBLISHER and e.name == topic]


def _latency_series(run: Run, topic: str, node: str) -> Iterator[Series]:
    """Yield the simulated time from a publish call to the callback that received the message."""
    ids = np.array(
        [
            e.id
            for e in run.entities.values()
            if e.kind is EntityKind.SUBSCRIPTION and e.name == topic and run.node_name(e.id) == node
        ],
        dtype=np.uint32,
    )
    times: list[npt.NDArray[np.float64]] = []
    values: list[npt.NDArray[np.float64]] = []
    known_first, known = 0, np.zeros(0, dtype=np.uint64)
    total = 0
    for number in range(len(run.segments)):
        try:
            segment = run.segment(number)
        except TraceError:
            continue
        # Stamps of this segment and the one before: no message is on its way for longer here.
        if len(known) and known_first + len(known) == segment.first:
            known = np.concatenate([known[-len(segment.events) :], segment.events["stamp"]])
        else:
            known = segment.events["stamp"]
        known_first = segment.last - len(known)
        own = segment.events[np.isin(segment.events["entity"], ids)]
        causes = own["cause_event"]
        usable = (causes != np.uint64(NO_EVENT)) & (causes >= np.uint64(known_first))
        own, causes = own[usable], causes[usable]
        sent = known[(causes - np.uint64(known_first)).astype(np.intp)]
        times.append(own["stamp"].astype(np.float64) / 1e9)
        values.append((own["stamp"] - sent).astype(np.float64) / 1e6)
        total += len(own)
        if number % 16 == 15:
            share = f"{(number + 1) / len(run.segments):.0%} read"
            yield Series(np.concatenate(times), np.concatenate(values), share)
    if times:
        yield Series(np.concatenate(times), np.concatenate(values), counted(total, "message"))
    else:
        yield Series(_NO_POINTS, _NO_POINTS)


def _chain_series(run: Run, name: str, measure: str) -> Iterator[Series]:
    """Yield what a chain took, at the time of each output."""
    topics, _, nodes = name.partition(VIA)
    via = nodes.split(", ") if nodes else ()
    for number, found in enumerate(measuring(run.trace, topics=topics.split(ARROW), via=via)):
        if found is None:
            yield Series(_NO_POINTS, _NO_POINTS, f"{(number + 1) / len(run.segments):.0%} read")
            continue
        moments = [one.moments(measure) for one in found.chains]
        times = np.concatenate([_NO_POINTS, *(one["output_ns"] / 1e9 for one in moments)])
        values = np.concatenate([_NO_POINTS, *(one["duration"] / 1e6 for one in moments)])
        order = np.argsort(times, kind="stable")
        yield Series(times[order], values[order], found.missing or f"{len(times):,} outputs")


# A plot of series in braille dots: eight to a cell, so that curves are curves in a terminal.

_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], dtype=np.uint16)
"""The bit of each dot, by row and column within a cell."""


@dataclass(frozen=True, slots=True)
class Plot:
    """Cells of a plot: ``rows`` of text, ``owner`` 0 (nothing), 1 (a), 2 (b) or 3 (both) per cell.

    ``low`` … ``high`` are the values at the bottom and top, ``start`` … ``end`` the times.
    """

    rows: tuple[str, ...]
    owner: tuple[tuple[int, ...], ...]
    low: float
    high: float
    start: float
    end: float


def plot(series: list[Series], width: int, height: int, cursor_s: float | None = None) -> Plot:
    """Draw one or two series into ``width`` x ``height`` cells; ``cursor_s`` is a vertical line.

    Consecutive points are joined. The second series is drawn with gaps, so that the two differ
    without colour. Values that are not finite are left out.
    """
    width, height = max(width, 1), max(height, 1)
    low, high, start, end = _bounds(series)
    scale = 1.0 if high / 2 - low / 2 < _MOST / 2 else 4.0  # differences do not overflow
    dots = np.zeros((2, height * 4, width * 2), dtype=np.bool_)
    for which, one in enumerate(series[:2]):
        finite = np.isfinite(one.values) & np.isfinite(one.times)
        times, values = one.times[finite], one.values[finite]
        if not len(times):
            continue
        x = (times - start) / (end - start) * (width * 2 - 1)
        y = (high / scale - values / scale) / (high / scale - low / scale) * (height * 4 - 1)
        _draw(dots[which], x, y)
        if which == 1:
            dots[1, :, 1::4] = False
            dots[1, :, 2::4] = False
    cells = np.zeros((2, height, width), dtype=np.uint16)
    for row in range(4):
        for column in range(2):
            cells |= np.where(dots[:, row::4, column::2], _DOTS[row, column], 0).astype(np.uint16)
    owner = (cells[0] > 0) * 1 + (cells[1] > 0) * 2
    merged = cells[0] | cells[1]
    text = [[chr(0x2800 + code) if code else " " for code in line] for line in merged.tolist()]
    if cursor_s is not None and start <= cursor_s <= end:
        column = int((cursor_s - start) / (end - start) * (width - 1))
        for line in text:
            if line[column] == " ":
                line[column] = "│"
    rows = tuple("".join(line) for line in text)
    return Plot(rows, tuple(tuple(line) for line in owner.tolist()), low, high, start, end)


_MOST = float(np.finfo(np.float64).max)


def _bounds(series: list[Series]) -> tuple[float, float, float, float]:
    values = np.concatenate([s.values[np.isfinite(s.values)] for s in series] or [np.zeros(0)])
    times = np.concatenate([s.times for s in series] or [np.zeros(0)])
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    start, end = (float(times.min()), float(times.max())) if len(times) else (0.0, 1.0)
    if high == low:
        # A constant runs through the middle.
        margin = abs(high) * 0.1 or 1.0
        low, high = max(low - margin, -_MOST), min(high + margin, _MOST)
    if end == start:
        end = start + 1.0
    return low, high, start, end


def _draw(
    dots: npt.NDArray[np.bool_], x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> None:
    """Set the dots of the line through the points."""
    dots[np.rint(y).astype(np.intp), np.rint(x).astype(np.intp)] = True
    for x0, y0, x1, y1 in zip(x[:-1], y[:-1], x[1:], y[1:], strict=True):
        steps = int(max(abs(x1 - x0), abs(y1 - y0)))
        if steps > 1:
            along = np.linspace(0.0, 1.0, steps + 1)
            columns = np.rint(x0 + (x1 - x0) * along).astype(np.intp)
            dots[np.rint(y0 + (y1 - y0) * along).astype(np.intp), columns] = True


# What a screen of plots needs of what it plots: runs, or recordings.


class PlotData(Protocol):
    """One or two things to plot. What decodes messages raises RsltraceError."""

    def title(self) -> str: ...

    def topics(self) -> list[str]: ...

    def others(self) -> list[PlotSource]:
        """Return what else can be plotted: rates, latencies."""
        ...

    def fields(self, topic: str) -> list[PlotSource]: ...

    def messages(self, topic: str) -> list[list[object]]:
        """Return some messages of a topic in each run, as many in each. Raises TraceError."""
        ...

    def first(self) -> tuple[str, str]:
        """Return topic and field to begin with; either may be empty."""
        ...

    def cursor_s(self) -> float | None: ...

    def series(self, source: PlotSource) -> Iterator[list[Series]]:
        """Yield the series of each run as they become known, the last time whole."""
        ...


def difference(series: list[Series]) -> Series | None:
    """Return a - b at the times of a, as far as b goes; None if there are no two."""
    if len(series) < 2 or not len(series[0].times) or not len(series[1].times):
        return None
    a, b = series
    inside = (a.times >= b.times[0]) & (a.times <= b.times[-1])
    times = a.times[inside]
    if not len(times):
        return None
    with np.errstate(invalid="ignore", over="ignore"):  # of two infinite numbers
        values = a.values[inside] - np.interp(times, b.times, b.values)
    finite = np.abs(values[np.isfinite(values)])
    most = float(finite.max()) if len(finite) else 0.0
    return Series(times, values, f"|a − b| ≤ {most:.4g}")
