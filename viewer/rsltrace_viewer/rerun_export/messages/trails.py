"""Chunks of tracks: where poses and satellite fixes went over the whole run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace_viewer.rerun_export.columns import (
    Column,
    constant,
    lists,
    make_chunk,
    strip_lists,
    vectors,
)
from rsltrace_viewer.rerun_export.messages.shapes import Paint

# The way something took, as one line through the whole run.
#
# A line that is there from the start shows in one look where a robot went and, of two runs, where
# they diverge. It is thinned out as it grows, so it costs the same for an hour as for a minute.

_POINTS_MAX = 4096


class Track:
    """Collects positions, at most some thousands of them, evenly over what was added."""

    def __init__(self) -> None:
        self._kept: list[npt.NDArray[np.float64]] = []
        self._count = 0
        self._stride = 1
        self._next = 0
        self._added = 0

    def add(self, positions: npt.NDArray[np.float64]) -> None:
        kept = positions[self._next - self._added :: self._stride]
        self._added += len(positions)
        self._next += len(kept) * self._stride
        kept = kept[np.isfinite(kept).all(axis=1)]
        if len(kept):
            self._kept.append(kept)
            self._count += len(kept)
        while self._count > _POINTS_MAX:
            thinned = np.concatenate(self._kept)[::2]
            self._kept, self._count = [thinned], len(thinned)
            self._stride *= 2
            self._next += (-self._next) % self._stride

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """What is kept, shape (n, k); empty with fewer than two points."""
        if self._count < 2:
            return np.zeros((0, 3), dtype=np.float64)
        return np.concatenate(self._kept)


_WIDTH = -1.0
"""On the screen."""
_LABEL_AT = {"a": 0.5, "b": 0.65}
_FIRST_LABEL_AT, _LABELS_APART = 0.4, 0.27


class Trails:
    """Gathers the positions of topics; each has a track at ``TOPIC/track``."""

    def __init__(self) -> None:
        self._poses: dict[str, tuple[Track, str, str, Paint]] = {}
        self._fixes: dict[str, tuple[Track, Paint]] = {}

    def add_poses(
        self, path: str, topic: str, frame: str, paint: Paint, positions: npt.NDArray[np.float64]
    ) -> None:
        """Add positions, shape (n, 3), in the frame of the first ones."""
        self._poses.setdefault(path, (Track(), topic, frame, paint))[0].add(positions)

    def add_fixes(self, path: str, paint: Paint, positions: npt.NDArray[np.float64]) -> None:
        """Add latitudes and longitudes, shape (n, 2)."""
        self._fixes.setdefault(path, (Track(), paint))[0].add(positions)

    def poses(self, label: str) -> Iterator[tuple[str, str, npt.NDArray[np.float64], list[Chunk]]]:
        """Yield path, frame (with its prefix), points and chunk of every track of poses. ``label``
        is written beside them, if there is one; otherwise the topic, if there are several."""
        names = len(self._poses) > 1 and not label
        for number, (topic_path, (track, topic, frame, paint)) in enumerate(self._poses.items()):
            points = track.points
            at = _LABEL_AT.get(label, _FIRST_LABEL_AT + number * _LABELS_APART) % 1
            if len(points):
                path = f"{topic_path}/track"
                strip = strip_lists(np.array([len(points)]), vectors(points))
                columns = (
                    (rr.LineStrips3D.descriptor_strips(), lists(np.array([1]), strip)),
                    (rr.LineStrips3D.descriptor_colors(), paint.faint.column(1)),
                    (rr.LineStrips3D.descriptor_radii(), constant(_WIDTH, 1, pa.float32())),
                    (rr.CoordinateFrame.descriptor_frame(), pa.array([frame])),
                    *(_named(label or topic, at, points, paint) if label or names else ()),
                )
                yield path, frame, points, make_chunk(path, (), columns)

    def fixes(self) -> Iterator[Chunk]:
        for topic_path, (track, paint) in self._fixes.items():
            points = track.points
            if len(points):
                flat = pa.array(np.ascontiguousarray(points).reshape(-1))
                kind = pa.list_(pa.field("item", pa.float64(), nullable=False), 2)
                places = pa.FixedSizeListArray.from_arrays(flat, type=kind)
                strip = strip_lists(np.array([len(points)]), places)
                columns = (
                    (rr.GeoLineStrings.descriptor_line_strings(), lists(np.array([1]), strip)),
                    (rr.GeoLineStrings.descriptor_colors(), paint.column(1)),
                )
                yield from make_chunk(f"{topic_path}/track", (), columns)


def _named(
    label: str, part: float, points: npt.NDArray[np.float64], paint: Paint
) -> tuple[Column, ...]:
    """Return what writes ``label`` on a track, after a part of it: elsewhere than on others, as
    tracks may be one."""
    at = int(len(points) * part)
    return (
        (rr.Points3D.descriptor_positions(), vectors(points[at : at + 1])),
        (rr.Points3D.descriptor_colors(), paint.column(1)),
        (rr.Points3D.descriptor_radii(), constant(_WIDTH, 1, pa.float32())),
        (rr.Points3D.descriptor_labels(), pa.array([[label]])),
        (rr.Points3D.descriptor_show_labels(), pa.array([True])),
    )
