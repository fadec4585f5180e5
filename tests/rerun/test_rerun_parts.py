"""The small parts of the export: texts, rates, curves, tracks, frames, markers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rerun")

import pyarrow as pa
import rerun as rr
from rsltrace_viewer.rerun_export.columns import FrameTree, clocks_for, lists
from rsltrace_viewer.rerun_export.divergence import document
from rsltrace_viewer.rerun_export.events.chunks import hashes, step_for
from rsltrace_viewer.rerun_export.messages.marker_rows import MarkerBoard
from rsltrace_viewer.rerun_export.messages.rows import curves_of
from rsltrace_viewer.rerun_export.messages.shapes import SHAPES, Paint, extent, shaded
from rsltrace_viewer.rerun_export.messages.trails import Track

from rsltrace.diff.facts.causes import Verdict
from rsltrace.diff.facts.remarks import DifferentJobs
from rsltrace.diff.result import ComparedRun, Diff

S = 1_000_000_000


@given(st.lists(st.integers(0, 2**64 - 1)))
def test_hashes_read_as_everywhere_else(values: list[int]) -> None:
    texts = hashes(np.array(values, dtype=np.uint64)).to_pylist()
    assert texts == [f"{value:016x}" for value in values]


@pytest.mark.parametrize(
    ("duration_ns", "step_ns"),
    [(60 * S, S), (S, 50_000_000), (3600 * S, 50 * S), (1, 1_000_000), (600 * S, 5 * S)],
)
def test_rates_have_round_steps(duration_ns: int, step_ns: int) -> None:
    assert step_for(duration_ns) == step_ns


@given(st.lists(st.integers(0, 300), max_size=30), st.integers(1, 20))
def test_a_track_is_evenly_thinned_and_small(sizes: list[int], scale: int) -> None:
    track = Track()
    total = 0
    for size in sizes:
        size *= scale
        track.add(np.stack([np.arange(total, total + size)] * 3, axis=1).astype(np.float64))
        total += size
    points = track.points
    assert len(points) <= 4096
    if total >= 2:
        assert points[0, 0] == 0
        steps = np.diff(points[:, 0])
        assert (steps == steps[0]).all()
        assert steps[0] <= max(total / 1024, 1)


def test_a_track_leaves_out_what_is_not_finite() -> None:
    track = Track()
    track.add(np.array([[0.0, 0, 0], [np.nan, 0, 0], [1, 0, 0]]))
    assert track.points.tolist() == [[0, 0, 0], [1, 0, 0]]


def test_curves_are_the_numbers_that_stand_together() -> None:
    messages = pa.array(
        [
            {
                "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"},
                "ok": True,
                "pose": {"x": 1.5, "y": 2.5},
                "covariance": [0.0] * 36,
                "wheels": [1, 2, 3],
                "names": ["a"],
                "layout": {"dim": [{"label": "x", "size": 3}], "data_offset": 0},
            }
        ]
    )
    found = {c.path: (c.names, c.scalars.to_pylist()) for c in curves_of(messages)}
    assert found == {
        "": (("ok",), [[1.0]]),
        "pose": (("x", "y"), [[1.5, 2.5]]),
        "wheels": (("[0]", "[1]", "[2]"), [[1.0, 2.0, 3.0]]),
    }


def test_switches_and_counts_have_nothing_between_two_messages() -> None:
    message = {"on": True, "mode": 2, "speed": {"x": 0.5}, "pins": [1, 0]}
    found = {curve.path: curve.discrete for curve in curves_of(pa.array([message]))}
    assert found == {"": True, "speed": False, "pins": True}


def test_frames_are_shown_by_the_root_they_hang_on() -> None:
    tree = FrameTree()
    tree.add_edge("map", "odom")
    tree.add_edge("odom", "base")
    tree.frames.update({"/scan": "base", "/odom": "odom", "/other": "lost", "/imu": "base"})
    tree.drawn.update({"/scan", "/odom", "/other"})
    assert tree.by_root() == {"map": ["/scan", "/odom"], "lost": ["/other"]}


def test_frames_in_a_circle_end_somewhere() -> None:
    tree = FrameTree()
    tree.add_edge("a", "b")
    tree.add_edge("b", "a")
    assert tree.root_of("a") in ("a", "b")


def test_time_of_day_is_shown_as_a_date_and_simulated_time_as_a_duration() -> None:
    assert not clocks_for([0, 5 * S])[1].dated
    assert clocks_for([0, 1_700_000_000 * S])[0].dated
    stamps = np.array([2**64 - 1, 1], dtype=np.uint64)
    assert clocks_for([0])[0].array(stamps).cast(pa.int64()).to_pylist() == [2**63 - 1, 1]


def marker(**fields: Any) -> dict[str, Any]:
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    base: dict[str, Any] = {
        "header": {"frame_id": "map"},
        "ns": "n",
        "id": 1,
        "type": 1,
        "action": 0,
        "pose": {"position": zero, "orientation": {**zero, "w": 1.0}},
        "scale": {"x": 1.0, "y": 1.0, "z": 1.0},
        "color": {"r": 1.0, "g": float("nan"), "b": 7.0, "a": 1.0},
        "lifetime": {"sec": 0, "nanosec": 0},
        "points": [],
        "colors": [],
        "text": "hello",
        "mesh_resource": "",
    }
    return {**base, **fields}


@pytest.mark.parametrize("type_number", range(14))
@pytest.mark.parametrize("count", [0, 1, 3, 4])
def test_every_type_of_marker_can_be_drawn(type_number: int, count: int) -> None:
    points = [{"x": float(i), "y": 0.0, "z": 0.0} for i in range(count)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RERUN_STRICT", "1")
        (change,) = MarkerBoard().changes(marker(type=type_number, points=points), 5)
    assert change.parts == ("n", "1")
    assert change.what is not None
    assert change.what.as_component_batches()


def test_deleting_all_markers_clears_those_that_are_there() -> None:
    board = MarkerBoard()
    list(board.changes({"markers": [marker(id=1), marker(id=2), marker(id=3)]}, 0))
    list(board.changes(marker(id=2, action=2), 0))
    changes = list(board.changes(marker(action=3), 0))
    assert [change.parts[1] for change in changes] == ["1", "3"]
    assert all(isinstance(change.what, rr.Clear) for change in changes)


def test_a_marker_says_when_its_life_is_over() -> None:
    (change,) = MarkerBoard().changes(marker(lifetime={"sec": 1, "nanosec": 5}), 10)
    assert change.expires_ns == 10 + S + 5


def test_a_marker_that_is_there_already_is_not_drawn_again() -> None:
    board = MarkerBoard()

    def drawn(stamp_ns: int, **fields: Any) -> bool:
        fields.setdefault("color", {"r": 1.0, "g": 0.0, "b": 0.0, "a": 1.0})
        (change,) = board.changes(marker(**fields), stamp_ns)
        return change.what is not None

    brief = {"sec": 0, "nanosec": 10}
    assert drawn(0)
    assert not drawn(5)
    assert drawn(6, text="another")
    list(board.changes(marker(action=2), 7))
    assert drawn(8, text="another")
    assert drawn(20, lifetime=brief)
    assert not drawn(30, lifetime=brief)
    assert drawn(50, lifetime=brief), "it was gone at 40"


def test_an_empty_path_and_an_empty_polygon_are_no_error() -> None:
    kind = pa.struct(
        [
            (
                "polygon",
                pa.struct([("points", pa.list_(pa.struct([(n, pa.float32()) for n in "xyz"])))]),
            )
        ]
    )
    corners = [{"x": 0.0, "y": 0.0, "z": 0.0}, {"x": 1.0, "y": 0.0, "z": 0.0}]
    messages = pa.array([{"polygon": {"points": []}}, {"polygon": {"points": corners}}], type=kind)
    drawing = SHAPES["geometry_msgs.msg.PolygonStamped"](messages, Paint(0xFF))
    strips = drawing.columns[0][1].to_pylist()
    assert strips == [[[]], [[[0, 0, 0], [1, 0, 0], [0, 0, 0]]]]


def test_lists_are_cut_by_their_counts() -> None:
    assert lists(np.array([2, 0, 1]), pa.array([1, 2, 3])).to_pylist() == [[1, 2], [], [3]]


def test_texts_of_a_trace_are_no_markdown() -> None:
    side = ComparedRun("a```.mcap", "0" * 16, 1, 2, True)
    diff = Diff(
        side,
        side,
        Verdict.SCHEDULE,
        DifferentJobs(("*bold* <b>\x1b[31m\n# title\n```", ""), ("a",)),
        1,
    )
    title, _, fence, *lines, end = document(diff).splitlines()
    assert (title, fence, end) == ("# The runs diverge", "````text", "````")
    assert "a```.mcap" in "\n".join(lines)
    assert not any(line.startswith(("#", "````")) or "\x1b" in line for line in lines)


def _clouds(*clouds: list[list[float]]) -> pa.ListArray:
    points = np.array([point for cloud in clouds for point in cloud]).reshape(-1, 3)
    flat = pa.array(points.astype(np.float32).reshape(-1))
    return lists(np.array([len(c) for c in clouds]), pa.FixedSizeListArray.from_arrays(flat, 3))


def test_a_cloud_is_brighter_above_and_a_stray_point_does_not_matter() -> None:
    ground = [[float(x), 0.0, 0.0] for x in range(200)]
    clouds = _clouds(ground, [[0, 0, 2.0], [0, 0, 4.0], *[[0.0, 0.0, 4.0]] * 50, [9e9, 0, 9e9]])
    dark, bright = shaded(clouds, Paint(0xFF8000FF)).to_pylist()
    assert set(dark) == {0x4C2600FF}
    assert bright[0] == 0xA55300FF
    assert set(bright[1:]) == {0xFF8000FF}
    box = extent(clouds)
    assert box is not None
    assert box[1].tolist() == [pytest.approx(193, abs=5), 0, 4]


def test_clouds_without_points_or_without_places_are_nothing_to_look_at() -> None:
    nan = float("nan")
    assert shaded(_clouds([], []), Paint(0xFF8000FF)).to_pylist() == [[], []]
    assert shaded(_clouds([[nan, nan, nan]]), Paint(0xFF8000FF)).to_pylist() == [[0xFF8000FF]]
    assert extent(_clouds([])) is None
    assert extent(_clouds([[nan, 0, 0]])) is None
