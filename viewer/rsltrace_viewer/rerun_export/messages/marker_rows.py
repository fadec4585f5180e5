"""Markers, logged: each at the time and event of its message, and gone when its life is over."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from rsltrace.trace.model.texts import printable
from rsltrace_viewer.rerun_export.columns import SIM_TIME, Clock, FrameTree
from rsltrace_viewer.rerun_export.messages.shapes import rotated
from rsltrace_viewer.rerun_export.moments import join

# Markers: many shapes in one message, each of which stays until it is replaced or deleted.
#
# A marker has an entity of its own, ``TOPIC/NAMESPACE/ID``, so that Rerun keeps showing it while
# others change. A message may hold anything, so they are drawn one at a time; markers are few.

_DELETE, _DELETE_ALL = 2, 3
_NS_PER_S = 1_000_000_000

Points = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Change:
    """What happens at a marker's place: ``what`` is drawn there, None if it is there already.

    ``parts`` is (namespace, id), ``frame`` empty for a deletion, ``expires_ns`` the simulated time
    at which it goes by itself, or None.
    """

    parts: tuple[str, str]
    frame: str
    what: rr.AsComponents | None
    expires_ns: int | None = None


class MarkerBoard:
    """What is on display on one topic, which deletions need to know."""

    def __init__(self) -> None:
        self._shown: dict[tuple[str, str], tuple[dict[str, Any], int | None]] = {}
        """What is there, and until when."""

    def changes(self, message: dict[str, Any], stamp_ns: int) -> Iterator[Change]:
        """Yield what a Marker or MarkerArray, as Python values, does to the board."""
        for marker in message.get("markers", [message]):
            parts = (printable(str(marker["ns"])) or "markers", str(marker["id"]))
            action = marker["action"]
            if action == _DELETE_ALL:
                for shown in sorted(self._shown):
                    yield Change(shown, "", rr.Clear(recursive=False))
                self._shown.clear()
            elif action == _DELETE:
                self._shown.pop(parts, None)
                yield Change(parts, "", rr.Clear(recursive=False))
            else:
                lifetime_ns = _duration_ns(marker["lifetime"])
                frame = str(marker["header"]["frame_id"])
                expires = stamp_ns + lifetime_ns if lifetime_ns > 0 else None
                # Nodes publish the same markers over and over; only the time in them differs.
                content = {**marker, "header": frame}
                before, until_ns = self._shown.get(parts, (None, None))
                same = before == content and (until_ns is None or until_ns >= stamp_ns)
                self._shown[parts] = content, expires
                yield Change(parts, frame, None if same else _shape(marker), expires)


def _duration_ns(value: dict[str, int]) -> int:
    return int(value["sec"]) * _NS_PER_S + int(value["nanosec"])


def _shape(marker: dict[str, Any]) -> rr.AsComponents:
    draw = _DRAW.get(marker["type"], _label)
    return draw(marker)


def _position(marker: dict[str, Any]) -> Points:
    at = marker["pose"]["position"]
    return np.array([[at["x"], at["y"], at["z"]]], dtype=np.float64)


def _turn(marker: dict[str, Any]) -> list[float]:
    q = marker["pose"]["orientation"]
    values = [float(q[name]) for name in "xyzw"]
    return values if any(values) else [0.0, 0.0, 0.0, 1.0]


def _points(marker: dict[str, Any]) -> Points:
    """Return the points of a marker where its pose puts them, shape (n, 3)."""
    rows = [[p["x"], p["y"], p["z"]] for p in marker["points"]]
    return rotated(_turn(marker), np.array(rows, dtype=np.float64).reshape(-1, 3)) + _position(
        marker
    )


def _scale(marker: dict[str, Any]) -> Points:
    scale = marker["scale"]
    return np.array([scale["x"], scale["y"], scale["z"]], dtype=np.float64)


def _rgba(colour: dict[str, float]) -> list[int]:
    values = (colour[name] for name in "rgba")
    return [int(min(max(value, 0.0), 1.0) * 255) if value == value else 0 for value in values]


def _colours(marker: dict[str, Any], count: int) -> list[list[int]]:
    each = marker["colors"]
    return [_rgba(c) for c in each] if len(each) == count and count else [_rgba(marker["color"])]


def _arrow(marker: dict[str, Any]) -> rr.AsComponents:
    scale = _scale(marker)
    if len(marker["points"]) >= 2:
        start, end = _points(marker)[:2]
        vector, radius = end - start, scale[0] / 2
    else:
        start = _position(marker)[0]
        vector = rotated(_turn(marker), np.array([[scale[0], 0.0, 0.0]]))[0]
        radius = scale[1] / 2
    return rr.Arrows3D(
        vectors=[vector], origins=[start], radii=[radius], colors=[_rgba(marker["color"])]
    )


def _box(marker: dict[str, Any]) -> rr.AsComponents:
    return rr.Boxes3D(
        centers=_position(marker),
        half_sizes=[_scale(marker) / 2],
        quaternions=[rr.Quaternion(xyzw=_turn(marker))],
        colors=[_rgba(marker["color"])],
        fill_mode="solid",
    )


def _ball(marker: dict[str, Any]) -> rr.AsComponents:
    return rr.Ellipsoids3D(
        centers=_position(marker),
        half_sizes=[_scale(marker) / 2],
        quaternions=[rr.Quaternion(xyzw=_turn(marker))],
        colors=[_rgba(marker["color"])],
        fill_mode="solid",
    )


def _cylinder(marker: dict[str, Any]) -> rr.AsComponents:
    scale = _scale(marker)
    return rr.Cylinders3D(
        centers=_position(marker),
        lengths=[scale[2]],
        radii=[scale[0] / 2],
        quaternions=[rr.Quaternion(xyzw=_turn(marker))],
        colors=[_rgba(marker["color"])],
    )


def _line_strip(marker: dict[str, Any]) -> rr.AsComponents:
    return rr.LineStrips3D(
        [_points(marker)],
        radii=[_scale(marker)[0] / 2],
        colors=[_rgba(marker["color"])],
    )


def _line_list(marker: dict[str, Any]) -> rr.AsComponents:
    points = _points(marker)
    pairs = points[: len(points) // 2 * 2].reshape(-1, 2, 3)
    return rr.LineStrips3D(pairs, radii=[_scale(marker)[0] / 2], colors=[_rgba(marker["color"])])


def _boxes(marker: dict[str, Any]) -> rr.AsComponents:
    points = _points(marker)
    return rr.Boxes3D(
        centers=points,
        half_sizes=[_scale(marker) / 2],
        quaternions=[rr.Quaternion(xyzw=_turn(marker))],
        colors=_colours(marker, len(points)),
        fill_mode="solid",
    )


def _dots(marker: dict[str, Any]) -> rr.AsComponents:
    points = _points(marker)
    return rr.Points3D(points, radii=[_scale(marker)[0] / 2], colors=_colours(marker, len(points)))


def _triangles(marker: dict[str, Any]) -> rr.AsComponents:
    points = _points(marker)
    points = points[: len(points) // 3 * 3]
    colours = _colours(marker, len(points))
    return rr.Mesh3D(
        vertex_positions=points,
        vertex_colors=colours if len(colours) == len(points) else colours * len(points),
    )


def _text(marker: dict[str, Any]) -> rr.AsComponents:
    return rr.Points3D(
        _position(marker),
        labels=[str(marker["text"])],
        colors=[_rgba(marker["color"])],
        show_labels=True,
    )


def _label(marker: dict[str, Any]) -> rr.AsComponents:
    """A mesh, whose file is not in the trace, or a newer type: where it is and what it is."""
    what = str(marker.get("mesh_resource", "")) or f"marker type {marker['type']}"
    return rr.Points3D(
        _position(marker), labels=[what], colors=[_rgba(marker["color"])], show_labels=True
    )


_DRAW: dict[int, Callable[[dict[str, Any]], rr.AsComponents]] = {
    0: _arrow,
    1: _box,
    2: _ball,
    3: _cylinder,
    4: _line_strip,
    5: _line_list,
    6: _boxes,
    7: _dots,
    8: _dots,
    9: _text,
    11: _triangles,
}


class MarkerRows:
    """Logs the markers of one run, a row at a time: they are of many kinds, and few."""

    def __init__(
        self,
        label: str,
        start_ns: int,
        clock: Clock,
        recording: rr.RecordingStream,
        frames: FrameTree,
    ) -> None:
        """``start_ns`` is that of the run; ``frames`` takes note of where markers are."""
        self._label = label
        self._start_ns = start_ns
        self._clock = clock
        self._recording = recording
        self._frames = frames
        self._boards: dict[str, MarkerBoard] = {}
        self._expiring: dict[str, int] = {}
        self._shown_in: dict[str, str] = {}

    def log(self, path: str, message: dict[str, Any], stamp_ns: int, event: int) -> None:
        """Log what a message on the topic at ``path`` changes."""
        board = self._boards.setdefault(path, MarkerBoard())
        for change in board.changes(message, stamp_ns):
            at = path + join(*change.parts)
            self._expire(at, stamp_ns)
            if change.what is not None:
                if change.frame:
                    self._note_frame(at, change.frame)
                self._set_time(stamp_ns, event)
                self._recording.log(at, change.what)
                self._log_frame(at)
            if change.expires_ns is not None:
                self._expiring[at] = change.expires_ns
        self._recording.reset_time()

    def end(self, end_ns: int) -> None:
        """Clear the markers whose life ended before the run did."""
        for path in list(self._expiring):
            self._expire(path, end_ns + 1)
        self._recording.reset_time()

    def _expire(self, path: str, before_ns: int) -> None:
        """Clear a marker whose life ended before it was replaced. No event does that, so it is on
        the timeline of simulated time only."""
        expires_ns = self._expiring.pop(path, None)
        if expires_ns is not None and expires_ns < before_ns:
            self._recording.reset_time()
            self._set_time(expires_ns)
            self._recording.log(path, rr.Clear(recursive=False))
            self._log_frame(path)

    def _note_frame(self, path: str, frame: str) -> None:
        first = path not in self._shown_in
        self._shown_in[path] = frame
        if first:
            self._frames.frames[path] = frame
            self._frames.drawn.add(path)
            self._set_time(self._start_ns, 0)
            self._log_frame(path)

    def _log_frame(self, path: str) -> None:
        """Log in which frame a marker is; once more after clearing it, or a view would complain
        that the nothing that is left is in no frame."""
        frame = self._shown_in.get(path)
        if frame is not None:
            name = f"{self._label}/{frame}" if self._label else frame
            self._recording.log(path, rr.CoordinateFrame(frame=name))

    def _set_time(self, stamp_ns: int, event: int | None = None) -> None:
        if event is not None:
            place = int(self._clock.places(np.array([event]))[0])
            self._recording.set_time(self._clock.order, sequence=place)
        if self._clock.dated:
            self._recording.set_time(SIM_TIME, timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._recording.set_time(SIM_TIME, duration=np.timedelta64(stamp_ns, "ns"))
