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
from rsltrace_viewer.rerun_export.messages.values import (
    columns,
    get,
    items,
    numbers,
    rotated_x,
)

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
        """Return it for every row."""
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


def frames_of(messages: pa.StructArray, field: str = "header.frame_id") -> list[Any]:
    """Return the frame of each message, or an empty list if the type has none."""
    try:
        return list(get(messages, field).to_pylist())
    except KeyError:
        return []
