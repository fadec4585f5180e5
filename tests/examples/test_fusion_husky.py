"""The filter on a real robot: 395 s of a Husky outdoors, measured against its own GPS.

The recording is not part of the project; without it these tests are skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

BAG = Path(__file__).resolve().parents[3] / "shared" / "data" / "husky_outdoor"
pytestmark = [
    pytest.mark.skipif(not BAG.exists(), reason="the Husky recording is not here"),
    pytest.mark.long,
]
Load = Callable[[str, str], ModuleType]
Point = tuple[float, float]


@dataclass
class Track:
    """What the filter and the sensors said, at each fix after the heading was found."""

    heading_at_s: float = math.nan
    filtered: list[Point] = field(default_factory=list)
    fixes: list[Point] = field(default_factory=list)
    wheels: list[Point] = field(default_factory=list)
    refused: int = 0
    filtered_length_m: float = 0.0
    wheel_length_m: float = 0.0


@pytest.fixture(scope="module")
def recording() -> list[tuple[str, int, Any]]:
    """(topic, stamp in ns, message) of the whole bag, in the order recorded."""
    rosbags = pytest.importorskip("rosbags.highlevel")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    with rosbags.AnyReader([BAG], default_typestore=store) as reader:
        result = []
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            result.append((connection.topic, stamp.sec * 10**9 + stamp.nanosec, message))
        return result


def run_filter(
    load: Load, recording: list[tuple[str, int, Any]], *, fixes_until_s: float = math.inf
) -> Track:
    """Run the filter as EkfNode does with the parameters of job_husky.yaml."""
    ekf_module = load("sensor_fusion", "fusion_demo.ekf")
    ekf, track = ekf_module.Ekf(), Track()
    aligner = load("sensor_fusion", "fusion_demo.alignment").TrackAligner(10.0)
    frame, start_ns, wheel, last = None, recording[0][1], None, None
    for topic, stamp_ns, message in recording:
        ekf.advance(stamp_ns)
        if topic == "/imu/data":
            ekf.update_yaw_rate(message.angular_velocity.y, 0.02**2)  # mounted on its side
        elif topic == "/fix":
            frame = frame or load("sensor_fusion", "fusion_demo.geodesy").LocalFrame(
                message.latitude, message.longitude
            )
            fix = frame.to_metres(message.latitude, message.longitude)
            here = float(ekf.state[0]), float(ekf.state[1])
            claimed = float(message.position_covariance[0])
            if aligner is not None:
                found = aligner.add(here, fix, claimed)
                if found is not None:
                    ekf.move_frame(found.turn, found.x, found.y, found.variance)
                    aligner = None
                    track.heading_at_s = (stamp_ns - start_ns) / 1e9
                continue
            track.filtered.append(here)
            track.fixes.append(fix)
            track.wheels.append(wheel)
            if (stamp_ns - start_ns) / 1e9 < fixes_until_s:
                taken = ekf.update_position(*fix, max(claimed, 2.0**2), 5.0)
                track.refused += not taken
        else:
            twist, place = message.twist.twist, message.pose.pose.position
            ekf.update_speed(twist.linear.x, 0.05**2)
            ekf.update_yaw_rate(twist.angular.z, 0.1**2)
            if aligner is None:
                here = float(ekf.state[0]), float(ekf.state[1])
                if last is not None:
                    track.filtered_length_m += math.dist(last, here)
                    track.wheel_length_m += math.dist(wheel, (place.x, place.y))
                last = here
            wheel = place.x, place.y
    return track


def rms_gap(a: list[Point], b: list[Point]) -> float:
    return math.sqrt(sum(math.dist(p, q) ** 2 for p, q in zip(a, b, strict=True)) / len(a))


def laid_on(track: list[Point], target: list[Point], aligner: Any) -> list[Point]:
    """Return ``track`` turned and shifted to fit ``target`` best: all that its shape can give."""
    for local, world in zip(track, target, strict=True):
        aligner.add(local, world, 1.0)
    fit = aligner._fit()
    cosine, sine = math.cos(fit.turn), math.sin(fit.turn)
    return [(fit.x + cosine * x - sine * y, fit.y + sine * x + cosine * y) for x, y in track]


def test_the_filter_keeps_to_gps_and_drives_the_distance_of_the_wheels(
    load_example: Load, recording: list[tuple[str, int, Any]]
) -> None:
    track = run_filter(load_example, recording)
    assert 5 < track.heading_at_s < 20
    assert track.refused < 0.02 * len(track.fixes)
    # GPS without correction errs by some metres and wanders; a filter that follows it any closer
    # than this would follow its errors, one that is further off has lost the track.
    assert 1.0 < rms_gap(track.filtered, track.fixes) < 2.5
    assert max(map(math.dist, track.filtered, track.fixes)) < 8
    assert track.filtered_length_m == pytest.approx(track.wheel_length_m, rel=0.03)
    # The robot comes back to where it set out.
    assert math.dist(track.filtered[-1], (0.0, 0.0)) < 20
    assert max(math.dist(point, (0.0, 0.0)) for point in track.filtered) > 140


def test_the_filter_beats_the_best_that_odometry_alone_can_be(
    load_example: Load, recording: list[tuple[str, int, Any]]
) -> None:
    track = run_filter(load_example, recording)
    aligner = load_example("sensor_fusion", "fusion_demo.alignment").TrackAligner(math.inf)
    odometry = laid_on(track.wheels, track.fixes, aligner)
    assert rms_gap(track.filtered, track.fixes) < 0.5 * rms_gap(odometry, track.fixes)


def test_without_gps_the_track_drifts_but_keeps_its_shape(
    load_example: Load, recording: list[tuple[str, int, Any]]
) -> None:
    whole = run_filter(load_example, recording)
    blind = run_filter(load_example, recording, fixes_until_s=200.0)
    assert blind.filtered_length_m == pytest.approx(whole.filtered_length_m, rel=0.03)
    drift = math.dist(blind.filtered[-1], whole.filtered[-1])
    assert 0.5 < drift < 15  # after 195 s and some 180 m on wheels and gyro alone
