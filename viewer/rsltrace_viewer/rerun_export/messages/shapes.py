"""Message types that Rerun's own loader leaves as data, turned into what Rerun draws.

Each function gets all messages of a chunk at once and returns drawings: components with a value,
or a list of values, per message. What a message has in its header says in which frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

from rsltrace_viewer.rerun_export.columns import (
    Column,
    constant,
    lists,
    strip_lists,
    vectors,
)

# Messages as Arrow gives them, by field: the fields of many messages as one numpy array.
#
# Rerun's reader hands out every message of a type it does not draw as one Arrow struct. A
# message's fields are found by dotted paths; sequences keep how many items each message has.


def messages_of(column: pa.Array) -> pa.StructArray | None:
    """Return the structs of a column that holds one per row, or None if it is anything else."""
    if not pa.types.is_list(column.type) or not pa.types.is_struct(column.type.value_type):
        return None
    structs = column.flatten()
    return structs if len(structs) == len(column) and structs.null_count == 0 else None


def get(structs: pa.StructArray, path: str) -> pa.Array:
    """Return the field at ``path`` (``pose.pose.position``) of each struct. Raises KeyError."""
    array: pa.Array = structs
    for name in path.split("."):
        place = array.type.get_field_index(name) if pa.types.is_struct(array.type) else -1
        if place < 0:
            raise KeyError(path)
        array = array.field(place)
    return array


def numbers(array: pa.Array) -> npt.NDArray[np.float64]:
    """Return an array of numbers as float64, shape (n,); null becomes NaN."""
    if pa.types.is_boolean(array.type):
        array = array.cast(pa.uint8())
    return np.asarray(array.to_numpy(zero_copy_only=False), dtype=np.float64)


def columns(structs: pa.StructArray, path: str, names: str) -> npt.NDArray[np.float64]:
    """Return the one-letter fields ``names`` (``xyz``) at ``path``, shape (n, len(names))."""
    at = get(structs, path) if path else structs
    return np.stack([numbers(get(at, name)) for name in names], axis=1)


def items(array: pa.Array) -> tuple[npt.NDArray[np.int64], pa.Array]:
    """Return (items per row, all items one after the other) of a column of sequences."""
    if pa.types.is_fixed_size_list(array.type):
        counts = np.full(len(array), array.type.list_size, dtype=np.int64)
    else:
        counts = np.diff(array.offsets.to_numpy()).astype(np.int64)
    return counts, array.flatten()


def rotated_x(quaternions: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return where the x axis points after rotations (x, y, z, w), shape (n, 3)."""
    x, y, z, w = quaternions.T
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=1)


def rotated(quaternion: Any, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return points, shape (n, 3), turned by one rotation (x, y, z, w)."""
    if not any(quaternion[:3]):
        return points
    axis = np.asarray(quaternion[:3], dtype=np.float64)
    twice = 2.0 * np.cross(axis, points)
    return np.asarray(points + float(quaternion[3]) * twice + np.cross(axis, twice))


ARROW_LENGTH = 0.6
"""In metres: about a robot."""
_POINT = -3.0
_HERE = -7.0
_LINE = -1.5
"""Negative sizes are those on the screen: visible however far away the view is."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """Something to draw at ``TOPIC/part``. ``position``, shape (n, 3), is for tracks."""

    part: str
    columns: tuple[Column, ...]
    position: npt.NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class Paint:
    """The colour of a topic, as 0xRRGGBBAA."""

    rgba: int

    @property
    def faint(self) -> Paint:
        """The same, darker: for what is behind."""
        channels = [(self.rgba >> shift & 255) * 3 // 5 for shift in (24, 16, 8)]
        return Paint(channels[0] << 24 | channels[1] << 16 | channels[2] << 8 | 255)

    def column(self, rows: int) -> pa.Array:
        return constant(self.rgba, rows, pa.uint32())


def pose_drawing(
    positions: npt.NDArray[np.float64], quaternions: npt.NDArray[np.float64], paint: Paint
) -> Drawing:
    """Return one pose per message: a dot, and an arrow along its x axis."""
    ones = np.ones(len(positions), dtype=np.int64)
    dot = (
        (rr.Points3D.descriptor_positions(), vectors(positions)),
        (rr.Points3D.descriptor_colors(), paint.column(len(ones))),
        (rr.Points3D.descriptor_radii(), constant(_HERE, len(ones), pa.float32())),
    )
    return Drawing("pose", (*_arrows(ones, positions, quaternions, paint), *dot), positions)


def _arrows(
    counts: npt.NDArray[np.int64],
    positions: npt.NDArray[np.float64],
    quaternions: npt.NDArray[np.float64],
    paint: Paint,
) -> tuple[Column, ...]:
    ahead = rotated_x(quaternions) * ARROW_LENGTH
    return (
        (rr.Arrows3D.descriptor_vectors(), lists(counts, vectors(ahead))),
        (rr.Arrows3D.descriptor_origins(), lists(counts, vectors(positions))),
        (rr.Arrows3D.descriptor_colors(), paint.column(len(counts))),
        (rr.Arrows3D.descriptor_radii(), constant(-3.0, len(counts), pa.float32())),
    )


def _pose_at(path: str) -> Callable[[pa.StructArray, Paint], Drawing]:
    def draw(messages: pa.StructArray, paint: Paint) -> Drawing:
        position = columns(messages, f"{path}.position" if path else "position", "xyz")
        turned = columns(messages, f"{path}.orientation" if path else "orientation", "xyzw")
        return pose_drawing(position, turned, paint)

    return draw


def _pose_array(messages: pa.StructArray, paint: Paint) -> Drawing:
    counts, poses = items(get(messages, "poses"))
    positions = columns(poses, "position", "xyz")
    quaternions = columns(poses, "orientation", "xyzw")
    return Drawing("poses", _arrows(counts, positions, quaternions, paint))


def _path(messages: pa.StructArray, paint: Paint) -> Drawing:
    counts, poses = items(get(messages, "poses"))
    return _strips("path", counts, columns(poses, "pose.position", "xyz"), paint)


def _polygon(messages: pa.StructArray, paint: Paint) -> Drawing:
    counts, corners = items(get(messages, "polygon.points"))
    points = columns(corners, "", "xyz")
    # The first corner once more closes it.
    ends = np.cumsum(counts)
    some = counts > 0
    points = np.insert(points, ends[some], points[(ends - counts)[some]], axis=0)
    return _strips("polygon", counts + some, points, paint)


def _strips(
    part: str, counts: npt.NDArray[np.int64], points: npt.NDArray[np.float64], paint: Paint
) -> Drawing:
    strips = strip_lists(counts, vectors(points))
    rows = len(counts)
    return Drawing(
        part,
        (
            (rr.LineStrips3D.descriptor_strips(), lists(np.ones(rows, dtype=np.int64), strips)),
            (rr.LineStrips3D.descriptor_colors(), paint.column(rows)),
            (rr.LineStrips3D.descriptor_radii(), constant(_LINE, rows, pa.float32())),
        ),
    )


def _points(
    part: str, counts: npt.NDArray[np.int64], points: npt.NDArray[np.float64], paint: Paint
) -> Drawing:
    rows = len(counts)
    return Drawing(
        part,
        (
            (rr.Points3D.descriptor_positions(), lists(counts, vectors(points))),
            (rr.Points3D.descriptor_colors(), paint.column(rows)),
            (rr.Points3D.descriptor_radii(), constant(_POINT, rows, pa.float32())),
        ),
    )


def _laser_scan(messages: pa.StructArray, paint: Paint) -> Drawing:
    counts, values = items(get(messages, "ranges"))
    ranges = numbers(values)

    def each(name: str) -> npt.NDArray[np.float64]:
        return np.repeat(numbers(get(messages, name)), counts)

    starts = np.repeat(np.cumsum(counts) - counts, counts)
    angles = each("angle_min") + (np.arange(len(ranges)) - starts) * each("angle_increment")
    with np.errstate(invalid="ignore"):
        hit = (ranges >= each("range_min")) & (ranges <= each("range_max")) & np.isfinite(ranges)
    ranges, angles = ranges[hit], angles[hit]
    points = np.stack(
        [ranges * np.cos(angles), ranges * np.sin(angles), np.zeros_like(ranges)], axis=1
    )
    message_of = np.repeat(np.arange(len(counts)), counts)
    kept = np.bincount(message_of[hit], minlength=len(counts)).astype(np.int64)
    return _points("points", kept, points, paint)


def _point(messages: pa.StructArray, paint: Paint) -> Drawing:
    points = columns(messages, "point", "xyz")
    return _points("point", np.ones(len(points), dtype=np.int64), points, paint)


SHAPES: Mapping[str, Callable[[pa.StructArray, Paint], Drawing]] = {
    "nav_msgs.msg.Odometry": _pose_at("pose.pose"),
    "geometry_msgs.msg.PoseStamped": _pose_at("pose"),
    "geometry_msgs.msg.PoseWithCovarianceStamped": _pose_at("pose.pose"),
    "geometry_msgs.msg.PoseArray": _pose_array,
    "geometry_msgs.msg.PointStamped": _point,
    "geometry_msgs.msg.PolygonStamped": _polygon,
    "nav_msgs.msg.Path": _path,
    "sensor_msgs.msg.LaserScan": _laser_scan,
}
"""By type: what draws it. Markers, which are many things in one message, are in ``markers``."""


def frames_of(messages: pa.StructArray) -> list[Any]:
    """Return the frame of each message, or an empty list if the type has none."""
    try:
        return list(get(messages, "header.frame_id").to_pylist())
    except KeyError:
        return []


# Colours of point clouds: each topic's own, from dark below to bright above.
#
# Rerun's loader gives all points of a cloud one colour, in which walls and ground are one heap.

_DARKEST = 0.3
_LOW, _HIGH = 2, 98
"""In per cent: what is above or below is a stray point."""

Box = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


def shaded(positions: pa.ListArray, paint: Paint) -> pa.ListArray:
    """Return a colour for each point of each cloud (a row of ``positions``)."""
    counts = np.asarray(positions.value_lengths().fill_null(0).to_numpy(), dtype=np.int64)
    heights = _clouds_points(positions)[:, 2]
    known = np.isfinite(heights)
    low, high = np.percentile(heights[known], (_LOW, _HIGH)) if known.any() else (0.0, 0.0)
    part = np.clip((heights - low) / max(high - low, 1e-9), 0.0, 1.0)
    bright = np.where(known, _DARKEST + (1 - _DARKEST) * part, 1.0)
    colours = np.full(len(heights), 255, dtype=np.uint32)
    for shift in (24, 16, 8):
        channel = (bright * (paint.rgba >> shift & 255)).astype(np.uint32)
        colours |= channel << np.uint32(shift)
    return lists(counts, pa.array(colours))


def extent(positions: pa.ListArray) -> Box | None:
    """Return the corners of the box that nearly all points of some clouds are in."""
    points = _clouds_points(positions)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    low, high = np.percentile(points, (_LOW, _HIGH), axis=0)
    return low, high


def _clouds_points(positions: pa.ListArray) -> npt.NDArray[np.float64]:
    """Return the points of all rows, shape (n, 3)."""
    values = positions.flatten().flatten().to_numpy(zero_copy_only=False)
    return np.asarray(values, dtype=np.float64).reshape(-1, 3)
