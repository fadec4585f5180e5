"""The messages of a trace: Rerun's own loader reads them, this puts them in their place.

What the loader draws (point clouds, images, transforms, grids, …) stays as it is, on our timelines
and below our root. What it leaves as data stays as data, and is drawn and plotted besides.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk, McapReader
from rerun.components import InterpolationMode

from rsltrace.errors import TraceError
from rsltrace.trace.format import (
    TOPIC_DETAILS,
    TOPIC_ENTITIES,
    TOPIC_EVENTS,
    TOPIC_OUTPUTS,
    TOPIC_ROSOUT,
)
from rsltrace.trace.reader import Trace
from rsltrace_viewer.rerun_export.columns import (
    AXES,
    Clock,
    Column,
    FrameTree,
    colour,
    lists,
    make_chunk,
)
from rsltrace_viewer.rerun_export.messages.marker_rows import MarkerRows
from rsltrace_viewer.rerun_export.messages.rows import (
    ComponentRows,
    Curves,
    LoadedColumns,
    Stream,
    Waiting,
    curves_of,
    is_command,
    left_out,
    loaded_columns,
)
from rsltrace_viewer.rerun_export.messages.shapes import (
    SHAPES,
    Drawing,
    Paint,
    extent,
    frames_of,
    messages_of,
    numbers,
    pose_drawing,
    shaded,
)
from rsltrace_viewer.rerun_export.messages.trails import Trails
from rsltrace_viewer.rerun_export.moments import Moments, Paths, join

_OWN = (TOPIC_EVENTS, TOPIC_OUTPUTS, TOPIC_ENTITIES, TOPIC_DETAILS, TOPIC_ROSOUT)
_DECODERS = ("ros2msg", "ros2_reflection", "raw", "schema")
"""``schema`` puts the type of a topic beside its messages. That also helps the viewer: without a
static row at its entity, 0.41 does not draw a grid map."""
_LOG_TIME = "message_log_time"
_FRAME_TYPE = b"rerun.components.TransformFrameId"
_MARKERS = ("visualization_msgs.msg.Marker", "visualization_msgs.msg.MarkerArray")
_IMAGES = {"Image:buffer", "EncodedImage:blob", "DepthImage:buffer", "EncodedDepthImage:blob"}
_SOLID = {"Points3D:positions", "GridMap:data", "Pinhole:image_from_camera"}
"""What the loader draws, flat and in space."""
_CLOUD, _CLOUD_COLOURS = "Points3D:positions", "Points3D:colors"
_RAW_CLOUD = "sensor_msgs.msg.PointCloud2:"
"""The bytes of a cloud, beside its points: the same once more."""

_BYTES_WAITING_MAX = 32 << 20


Points: TypeAlias = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], pa.ListArray]
"""Stamps in nanoseconds, events, and a list of values for each."""


@dataclass(slots=True)
class Seen:
    """What there is to show, gathered while the messages pass; the layout is made from it."""

    frames: FrameTree = field(default_factory=FrameTree)
    images: dict[str, None] = field(default_factory=dict)
    fixes: dict[str, None] = field(default_factory=dict)
    curves: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """By path, the names of the curves there."""
    topic_of: dict[str, str] = field(default_factory=dict)
    """By path of curves or drawings, the topic."""
    points: dict[str, list[Points]] = field(default_factory=dict)
    """By path, of one of two runs, what its curves show."""
    extents: dict[str, tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]] = field(
        default_factory=dict
    )
    """By path of a track or a cloud, the corners of the box around it."""


class MessageRows:
    """Makes chunks of the messages of one trace; memory is that of a chunk of the file.

    ``left_out`` are topics without their messages, and why.
    """

    def __init__(self, trace: Trace, paths: Paths, clock: Clock, recording: rr.RecordingStream):
        self.seen = Seen()
        self.left_out = left_out(trace)
        self._trace = trace
        self._paths = paths
        self._clock = clock
        self._moments = Moments(trace)
        self._topics = {join(c.topic): c.topic for c in trace.channels.values()}
        self._numbers = {topic: i for i, topic in enumerate(sorted(self._topics.values()))}
        self._waiting: dict[Stream, Waiting] = {}
        self._prefix = f"{paths.label}/" if paths.label else ""
        self._trails = Trails()
        self._markers = MarkerRows(paths.label, trace.start_ns, clock, recording, self.seen.frames)

    def chunks(self) -> Iterator[Chunk]:
        """Yield all chunks, the tracks last. Raises TraceError if the loader cannot read it."""
        for _ in self._trace.messages_of(frozenset(self._trace.channels)):
            pass  # the loader takes chunks as they are, and reads some damaged ones for ever
        not_read = [f"^{re.escape(topic)}$" for topic in (*_OWN, *self.left_out)]
        try:
            reader = McapReader(
                self._trace.name,
                timeline_type=self._clock.timeline_type,
                decoders=_DECODERS,
                exclude_topic_regex=not_read,
                recover=not self._trace.complete,
            )
            for chunk in reader.stream():
                yield from self._chunk(chunk)
            for stream in list(self._waiting):
                yield from self._flush(stream)
        except (RuntimeError, ValueError, OSError) as error:
            raise TraceError(
                f"{self._trace.name}: Rerun cannot read its messages ({error})"
            ) from error
        yield from self._ends()

    def _chunk(self, chunk: Chunk) -> Iterator[Chunk]:
        topic, below = self._place(str(chunk.entity_path))
        if not topic:
            return
        path = self._paths.topic(topic) + below
        batch = chunk.to_record_batch()
        columns = loaded_columns(batch)
        if chunk.is_static:
            yield from self._static(path, topic, columns)
            return
        stamps = batch.column(_LOG_TIME).cast(pa.int64()).to_numpy()
        stream = (path, tuple(f.name for f, _ in columns))
        events, _ = self._moments.of_messages(topic, stream, stamps)
        waiting = self._waiting.setdefault(stream, Waiting(topic, path))
        waiting.add(columns, stamps, events)
        if waiting.full:
            yield from self._flush(stream)
        elif sum(each.bytes for each in self._waiting.values()) >= _BYTES_WAITING_MAX:
            for each in list(self._waiting):
                yield from self._flush(each)

    def _flush(self, stream: Stream) -> Iterator[Chunk]:
        """Yield what waits of a sequence of rows."""
        rows = self._waiting.pop(stream).joined(self._clock)
        yield from self._as_it_is(rows)
        yield from self._derived(rows)

    def _place(self, loaded: str) -> tuple[str, str]:
        """Return the topic of an entity that the loader made, and the path below the topic's."""
        path = loaded
        while path:
            if path in self._topics:
                return self._topics[path], loaded[len(path) :]
            path = path.rpartition("/")[0]
        return "", ""

    def _static(self, path: str, topic: str, columns: LoadedColumns) -> list[Chunk]:
        """Names of curves and the like."""
        for f, column in columns:
            if f.name == "SeriesLines:names":
                names = tuple(f"{self._paths.label} {n}".strip() for n in column[0].as_py())
                self.seen.curves[path] = names
                return self._curve_names(path, names, steps=is_command(topic))
        return make_chunk(path, (), columns)

    def _as_it_is(self, rows: ComponentRows) -> Iterator[Chunk]:
        """What the loader made, on our timelines, with the run's own frames."""
        columns = []
        for f, column in rows.columns:
            if f.name.startswith(_RAW_CLOUD):
                continue
            if (f.metadata or {}).get(b"rerun:component_type") == _FRAME_TYPE:
                if f.name == "CoordinateFrame:frame":
                    yield from self._note_frame(rows.path, column)
                column = self._own_frames(column)
            columns.append((f, column))
        names = {f.name for f, _ in rows.columns}
        if names & _IMAGES:
            self.seen.images[rows.path] = None
        if names & _SOLID:
            self.seen.frames.drawn.add(rows.path)
        self.seen.topic_of.setdefault(rows.path, rows.topic)
        if columns:
            yield from make_chunk(rows.path, rows.times, columns)
        if _CLOUD in names:
            yield from self._cloud(rows, names)

    def _cloud(self, rows: ComponentRows, names: set[str]) -> Iterator[Chunk]:
        """Colour a cloud that has no colours of its own, and note where it is."""
        positions = next(column for f, column in rows.columns if f.name == _CLOUD)
        if _CLOUD_COLOURS not in names:
            colours = shaded(positions, self._paint(rows.topic))
            columns = ((rr.Points3D.descriptor_colors(), colours),)
            yield from make_chunk(rows.path, rows.times, columns)
        box, known = extent(positions), self.seen.extents.get(rows.path)
        if box is not None:
            low, high = box if known is None else known
            self.seen.extents[rows.path] = np.minimum(low, box[0]), np.maximum(high, box[1])

    def _derived(self, rows: ComponentRows) -> Iterator[Chunk]:
        by_name = {f.name: column for f, column in rows.columns}
        for name, column in by_name.items():
            type_name, _, kind = name.partition(":")
            messages = messages_of(column) if kind == "message" else None
            if messages is None:
                continue
            if type_name in _MARKERS:
                for message, stamp_ns, event in zip(
                    messages.to_pylist(), rows.stamps_ns.tolist(), rows.events.tolist(), strict=True
                ):
                    self._markers.log(rows.path, message, stamp_ns, event)
                continue
            steps = is_command(rows.topic, type_name)
            draw = SHAPES.get(type_name)
            curves = (one for one in curves_of(messages) if one.path or draw is None)
            yield from self._curves(rows, curves, steps=steps)  # no limits of a scan
            if draw is not None:
                yield from self._draw(rows, draw(messages, self._paint(rows.topic)), messages)
        translations = by_name.get("InstancePoses3D:translations")
        if translations is not None:
            yield from self._curves(rows, _vector_curves("xyz", translations))
            yield from self._loaded_pose(rows, by_name)
        fixes = by_name.get("GeoPoints:positions")
        if fixes is not None:
            yield from self._fix(rows, fixes, by_name.get("altitude"))
        if "Transform3D:child_frame" in by_name and "Transform3D:parent_frame" in by_name:
            self._note_transforms(by_name)
        if "Scalars:scalars" in by_name:
            self.seen.curves.setdefault(rows.path, ())
            self._note_points(rows.path, rows, by_name["Scalars:scalars"])

    # Frames.

    def _own_frames(self, column: pa.Array) -> pa.Array:
        if not self._prefix:
            return column
        names = [
            None if row is None else [f"{self._prefix}{name}" for name in row]
            for row in column.to_pylist()
        ]
        return pa.array(names, type=column.type)

    def _note_frame(self, path: str, column: pa.Array) -> list[Chunk]:
        """Return the frame of an entity's first data, as that of the start of the run: a view
        complains about entities that are in no frame, even when they have no data yet."""
        names = column.flatten()
        if path in self.seen.frames.frames or not len(names):
            return []
        frame = names[0].as_py()
        self.seen.frames.frames[path] = frame
        start_ns = np.array([self._trace.start_ns])
        return make_chunk(
            path,
            self._clock.times(start_ns, np.array([0])),
            ((rr.CoordinateFrame.descriptor_frame(), pa.array([f"{self._prefix}{frame}"])),),
        )

    def _note_transforms(self, by_name: dict[str, pa.Array]) -> None:
        parents = by_name["Transform3D:parent_frame"].flatten()
        children = by_name["Transform3D:child_frame"].flatten()
        for pair in set(zip(parents.to_pylist(), children.to_pylist(), strict=False)):
            self.seen.frames.add_edge(*pair)

    # What is drawn.

    def _paint(self, topic: str) -> Paint:
        return Paint(colour(self._paths.label, self._numbers[topic]))

    def _draw(
        self, rows: ComponentRows, drawing: Drawing, messages: pa.StructArray
    ) -> Iterator[Chunk]:
        frames = frames_of(messages) or [""] * len(messages)
        yield from self._drawing(rows, drawing, frames)

    def _drawing(self, rows: ComponentRows, drawing: Drawing, frames: list[Any]) -> Iterator[Chunk]:
        path = f"{rows.path}/{drawing.part}"
        names = pa.array([str(name) for name in frames])
        column = lists(np.ones(len(frames), dtype=np.int64), names)
        yield from self._note_frame(path, column)
        self.seen.frames.drawn.add(path)
        self.seen.topic_of.setdefault(path, rows.topic)
        frame = self._own_frames(column)
        columns = (*drawing.columns, (rr.CoordinateFrame.descriptor_frame(), frame))
        yield from make_chunk(path, rows.times, columns)
        if drawing.position is not None:
            first = f"{self._prefix}{frames[0]}"
            paint = self._paint(rows.topic)
            self._trails.add_poses(rows.path, rows.topic, first, paint, drawing.position)

    def _loaded_pose(self, rows: ComponentRows, by_name: dict[str, pa.Array]) -> Iterator[Chunk]:
        """The loader knows poses, but draws nothing where they are."""
        positions = _flat(by_name["InstancePoses3D:translations"], 3)
        quaternions = _flat(by_name["InstancePoses3D:quaternions"], 4)
        frames = by_name["CoordinateFrame:frame"].flatten().to_pylist()
        if len(positions) == len(quaternions) == len(frames) == len(rows.stamps_ns):
            drawing = pose_drawing(positions, quaternions, self._paint(rows.topic))
            yield from self._drawing(rows, drawing, frames)

    def _fix(
        self, rows: ComponentRows, fixes: pa.Array, altitude: pa.Array | None
    ) -> Iterator[Chunk]:
        self.seen.fixes[rows.path] = None
        positions = _flat(fixes, 2)
        self._trails.add_fixes(rows.path, self._paint(rows.topic), positions)
        yield from self._curves(rows, _vector_curves(("latitude", "longitude"), fixes))
        if altitude is not None:
            counts = np.ones(len(altitude), dtype=np.int64)
            scalars = lists(counts, pa.array(numbers(altitude.flatten())))
            yield from self._curves(rows, iter((Curves("altitude", ("altitude",), scalars),)))

    # Curves.

    def _curves(
        self, rows: ComponentRows, curves: Iterator[Curves], *, steps: bool = False
    ) -> Iterator[Chunk]:
        for curve in curves:
            path = rows.path + (join(curve.path) if curve.path else "")
            scalars = rr.Scalars.descriptor_scalars()
            yield from make_chunk(path, rows.times, ((scalars, curve.scalars),))
            self._note_points(path, rows, curve.scalars)
            known = self.seen.curves.get(path, ())
            if len(curve.names) > len(known):
                names = tuple(f"{self._paths.label} {name}".strip() for name in curve.names)
                self.seen.curves[path] = names
                self.seen.topic_of[path] = rows.topic
                yield from self._curve_names(path, names, steps=steps or curve.discrete)

    def _note_points(self, path: str, rows: ComponentRows, values: pa.ListArray) -> None:
        if self._paths.label:
            points = (rows.stamps_ns, rows.events, values)
            self.seen.points.setdefault(path, []).append(points)

    def _curve_names(self, path: str, names: tuple[str, ...], *, steps: bool) -> list[Chunk]:
        one = np.array([len(names)])
        axes = [name.rpartition(" ")[2] for name in names]
        columns: list[Column] = [
            (rr.SeriesLines.descriptor_names(), lists(one, pa.array(list(names))))
        ]
        if self._paths.label or AXES.issuperset(axes):
            paints = [colour(self._paths.label, i, axis) for i, axis in enumerate(axes)]
            paint = pa.array(paints, type=pa.uint32())
            columns.append((rr.SeriesLines.descriptor_colors(), lists(one, paint)))
        if steps:
            mode = pa.array([InterpolationMode.StepAfter.value] * len(names), type=pa.uint8())
            columns.append((rr.SeriesLines.descriptor_interpolation_mode(), lists(one, mode)))
        return make_chunk(path, (), columns)

    def _ends(self) -> Iterator[Chunk]:
        self._markers.end(self._trace.end_ns)
        for path, frame, points, chunks in self._trails.poses(self._paths.label):
            self.seen.frames.frames[path] = frame.removeprefix(self._prefix)
            self.seen.frames.drawn.add(path)
            self.seen.extents[path] = (points.min(axis=0), points.max(axis=0))
            yield from chunks
        yield from self._trails.fixes()


def _flat(column: pa.Array, size: int) -> npt.NDArray[np.float64]:
    """Return a column of one fixed-size list per row as an array of shape (rows, size)."""
    values = column.flatten().flatten().to_numpy()
    return np.asarray(values, dtype=np.float64).reshape(-1, size)


def _vector_curves(names: str | tuple[str, ...], column: pa.Array) -> Iterator[Curves]:
    values = _flat(column, len(names))
    if len(values) == len(column):
        counts = np.full(len(values), len(names), dtype=np.int64)
        yield Curves("position", tuple(names), lists(counts, pa.array(values.reshape(-1))))
