"""What bags play otherwise than recorded: one field, the order of two messages, one once more."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import PoseWithCovariance  # noqa: E402
from hypothesis import given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from rclpy.node import Node  # noqa: E402
from sensor_msgs.msg import LaserScan, Range  # noqa: E402
from std_msgs.msg import Bool, Int8, String, UInt64  # noqa: E402

from rsltrace.adapters.rclpy.messages.codec import codec_for  # noqa: E402
from rsltrace.diff import diff_files  # noqa: E402
from rsltrace.errors import JobError, RsltraceError  # noqa: E402
from rsltrace.job import Job, NodeSpec  # noqa: E402
from rsltrace.job.parts.fault import FaultSpec  # noqa: E402
from rsltrace.run import record  # noqa: E402
from rsltrace.run.plans.faults import FieldChangeError, field_changer  # noqa: E402
from rsltrace.trace.reader import Trace  # noqa: E402
from tests.tiers import cases  # noqa: E402

BAG = Path(__file__).parents[2] / "campaigns/explore/bugs/bags/nan_poisons_average/drive"
"""Forty messages on /range, 2.0 - 0.04 n."""

heard: list[float] = []


class Listener(Node):
    def __init__(self) -> None:
        super().__init__("listener")
        self.create_subscription(Range, "range", lambda m: heard.append(m.range), 10)


def play(*faults: dict[str, Any], trace: Path | None = None) -> tuple[list[float], Any]:
    """Return what the listener gets, and the result."""
    heard.clear()
    job = Job(nodes=[NodeSpec(node=Listener)], bags=[{"path": str(BAG)}], faults=faults)
    result = record(job, trace)
    return [round(value, 2) for value in heard], result


def plain(number: int) -> float:
    return round(2.0 - 0.04 * number, 2)


PLAIN = [plain(number) for number in range(1, 41)]


@pytest.mark.long
def test_a_message_of_a_bag_changes_swaps_or_comes_again_and_the_trace_has_that(
    tmp_path: Path,
) -> None:
    faults: list[dict[str, Any]] = [
        {"change": "/range", "message": 3, "field": "range", "value": 7.5},
        {"swap": "/range", "message": 10},
        {"repeat": "/range", "message": 20},
        {"change": "/range", "message": 40, "field": "range", "scale": -2},
    ]
    found, result = play(*faults, trace=tmp_path / "a.mcap")
    wanted = list(PLAIN)
    wanted[2], wanted[9], wanted[10], wanted[19] = 7.5, PLAIN[10], PLAIN[9], PLAIN[18]
    wanted[39] = round(-2 * plain(40), 2)
    assert found == wanted
    assert result.notes == ()
    with Trace.open(tmp_path / "a.mcap") as trace:
        values: list[Any] = [trace.decode("/range", m[-1]) for m in trace.messages("/range")]
        assert [round(value.range, 2) for value in values] == wanted
    play(trace=tmp_path / "b.mcap")
    divergence = diff_files(tmp_path / "a.mcap", tmp_path / "b.mcap").divergences[0]
    assert "(range 7.5 → 1.88)" in divergence.sentence
    assert "faults.0" in divergence.root_sentence
    play(*faults[1:2], trace=tmp_path / "c.mcap")
    divergence = diff_files(tmp_path / "c.mcap", tmp_path / "b.mcap").divergences[0]
    assert "are swapped" in divergence.sentence
    assert "faults.0" in divergence.root_sentence


def test_the_last_message_has_none_to_change_places_with_and_what_is_not_there_is_told() -> None:
    found, result = play(
        {"swap": "/range", "message": 40},
        {"repeat": "/range", "message": 41},
        {"change": "/speed", "message": 1, "field": "x", "value": 1},
    )
    assert found == PLAIN
    notes = "\n".join(result.notes)
    assert "faults[0]: this fault did not happen: no message on /range follows" in notes
    assert "faults[1]: this fault did not happen: bags played 40 messages on /range" in notes
    assert "faults[2]: this fault did not happen: bags played 0 messages on /speed" in notes


def test_a_field_that_is_not_there_or_cannot_be_that_is_an_error_with_its_place() -> None:
    fault = {"change": "/range", "message": 1, "field": "rnge", "value": 1}
    with pytest.raises(RsltraceError, match=r"faults\[0\]: .*Range has no field rnge .*range'"):
        play(fault)
    with pytest.raises(JobError):
        play({"change": "/range", "message": 1, "field": "x y", "value": 1})


def changed(message: Any, field: str, **what: Any) -> Any:
    codec = codec_for(type(message))
    spec = FaultSpec(change="/t", message=1, field=field, **what)
    return codec.deserialize(field_changer(type(message), spec)(codec.serialize(message)))


def test_items_lengths_texts_and_bytes_change() -> None:
    scan = LaserScan(ranges=[1.0, 2.0, 3.0])
    assert changed(scan, "ranges[-1]", value="inf").ranges.tolist() == [1.0, 2.0, math.inf]
    assert changed(scan, "ranges[*]", offset=0.5).ranges.tolist() == [1.5, 2.5, 3.5]
    assert changed(scan, "ranges", length=5).ranges.tolist() == [1.0, 2.0, 3.0, 3.0, 3.0]
    assert changed(scan, "ranges", length=0).ranges.tolist() == []
    assert changed(scan, "ranges", value=[4, 5]).ranges.tolist() == [4.0, 5.0]
    assert changed(LaserScan(), "ranges", length=2).ranges.tolist() == [0.0, 0.0]
    assert changed(scan, "header.frame_id", value="x").header.frame_id == "x"
    status = DiagnosticArray(status=[DiagnosticStatus(level=b"\1"), DiagnosticStatus()])
    assert [s.level for s in changed(status, "status[*].level", value=2).status] == [b"\2", b"\2"]
    assert [s.level for s in changed(status, "status[0].level", offset=9).status] == [b"\n", b"\0"]
    assert changed(status, "status[0].level", scale=300).status[0].level == b"\xff"
    assert len(changed(status, "status", length=3).status) == 3
    assert changed(PoseWithCovariance(), "covariance[35]", value=2.5).covariance[35] == 2.5
    assert changed(Bool(), "data", value=True).data is True
    assert changed(String(data="a"), "data", value="nan").data == "nan"


@pytest.mark.parametrize(
    ("message", "field", "what", "said"),
    [
        (LaserScan(), "ranges", {"value": 1}, r"ranges\[\*\]"),
        (LaserScan(), "ranges[0]", {"value": 1}, "it has 0 items"),
        (LaserScan(), "header", {"value": 1}, "name a field of it"),
        (LaserScan(), "header[0]", {"value": 1}, "is no array"),
        (LaserScan(), "angle_min.x", {"value": 1}, "has no fields"),
        (LaserScan(), "angle_min", {"length": 1}, "is no array"),
        (LaserScan(), "angle_min", {"value": 1e39}, "is from -3.4"),
        (LaserScan(), "header.frame_id", {"scale": 2}, "is no number"),
        (LaserScan(), "header.frame_id", {"value": 2}, "is text"),
        (DiagnosticArray(), "status.level", {"value": 2}, r"write status\[0\]"),
        (PoseWithCovariance(), "covariance", {"length": 3}, "exactly 36 items"),
        (Int8(), "data", {"value": 128}, "from -128 to 127"),
        (Int8(), "data", {"value": "nan"}, "whole number"),
        (Bool(), "data", {"value": 1}, "true or false"),
    ],
)
def test_what_a_field_cannot_be_is_refused(
    message: Any, field: str, what: dict[str, Any], said: str
) -> None:
    with pytest.raises(FieldChangeError, match=said):
        changed(message, field, **what)


@settings(deadline=None, max_examples=cases(10, 60))
@given(st.integers(0, 2**64 - 1), st.sampled_from([-1, 0.5, 2, 3]), st.integers(-(10**6), 10**6))
def test_numbers_stay_within_the_limits_of_their_type(old: int, scale: float, offset: int) -> None:
    most = 2**64 - 1
    exact = int(scale) * old if scale == int(scale) else round(scale * old)
    assert changed(UInt64(data=old), "data", scale=scale).data == min(max(exact, 0), most)
    assert changed(UInt64(data=old), "data", offset=offset).data == min(max(old + offset, 0), most)
