"""The mathematics of the sensor-fusion example: filter, frames, alignment and course."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

Load = Callable[[str, str], ModuleType]
DT_NS = 10_000_000


@pytest.fixture
def part(load_example: Load) -> Callable[[str], Any]:
    return lambda name: load_example("sensor_fusion", f"fusion_demo.{name}")


def test_prediction_drives_a_circle(part: Callable[[str], Any]) -> None:
    ekf = part("ekf").Ekf()
    ekf.set_pose(1.0, 2.0, 0.0)
    ekf.state[3:] = (1.0, 0.5)  # m/s, rad/s: a circle of 2 m around (1, 4)
    ekf.advance(0)
    for i in range(1, 315):
        ekf.advance(i * DT_NS)
        assert math.hypot(ekf.state[0] - 1.0, ekf.state[1] - 4.0) == pytest.approx(2.0, abs=1e-4)
    assert ekf.state[2] == pytest.approx(0.5 * 3.14)


def test_covariance_is_that_of_the_full_matrix_equations(part: Callable[[str], Any]) -> None:
    """Against the textbook: numerical Jacobian, F P F' + Q, (I - K H) P."""
    module = part("ekf")
    ekf = module.Ekf()
    rng = np.random.default_rng(3)
    root = rng.normal(size=(5, 5))
    ekf.covariance[:] = root @ root.T
    ekf.state[:] = (1.0, -2.0, 0.7, 1.3, -0.4)
    ekf.advance(0)
    before, p_before, dt = ekf.state.copy(), ekf.covariance.copy(), 0.05

    def motion(state: np.ndarray) -> np.ndarray:
        x, y, yaw, v, w = state
        middle = yaw + w * dt / 2
        moved = (x + v * math.cos(middle) * dt, y + v * math.sin(middle) * dt, yaw + w * dt, v, w)
        return np.array(moved)

    steps = np.eye(5) * 1e-6
    f = np.array([(motion(before + s) - motion(before - s)) / 2e-6 for s in steps]).T
    noise = module.Noise()
    sigmas = (noise.position, noise.position, noise.yaw, noise.speed, noise.yaw_rate)
    q = np.diag(np.square(sigmas)) * dt
    ekf.advance(50_000_000)
    np.testing.assert_allclose(ekf.state, motion(before), rtol=1e-12)
    np.testing.assert_allclose(ekf.covariance, f @ p_before @ f.T + q, rtol=1e-7, atol=1e-9)

    p, state = ekf.covariance.copy(), ekf.state.copy()
    ekf.update_speed(2.0, 0.3)
    gain = p[:, 3] / (p[3, 3] + 0.3)
    np.testing.assert_allclose(ekf.state, state + gain * (2.0 - state[3]), rtol=1e-12)
    np.testing.assert_allclose(ekf.covariance, p - np.outer(gain, p[3]), rtol=1e-10, atol=1e-12)


@pytest.mark.long
def test_covariance_stays_symmetric_and_positive(part: Callable[[str], Any]) -> None:
    ekf_class = part("ekf").Ekf
    speed, rate, place = st.floats(-3, 3), st.floats(-2, 2), st.floats(-50, 50)
    step = st.one_of(
        st.tuples(st.just("advance"), st.integers(-(10**8), 3 * 10**9)),
        st.tuples(st.just("speed"), speed, st.floats(1e-4, 10)),
        st.tuples(st.just("yaw_rate"), rate, st.floats(1e-4, 10)),
        st.tuples(st.just("position"), place, place, st.floats(1e-2, 100)),
        st.tuples(st.just("frame"), st.floats(-4, 4), place, place),
    )

    @settings(deadline=None)
    @given(st.lists(step, max_size=30))
    def check(steps: list[tuple[Any, ...]]) -> None:
        ekf, now = ekf_class(), 0
        for kind, *values in steps:
            if kind == "advance":
                now += values[0]
                ekf.advance(now)
            elif kind == "frame":
                ekf.move_frame(*values, 0.01)
            else:
                getattr(ekf, f"update_{kind}")(*values)
            np.testing.assert_allclose(ekf.covariance, ekf.covariance.T, rtol=1e-9, atol=1e-12)
            least = np.linalg.eigvalsh(ekf.covariance).min()
            assert least > -1e-9 * np.abs(ekf.covariance).max()
            assert -math.pi <= ekf.state[2] <= math.pi

    check()


def test_a_late_measurement_does_not_move_time(part: Callable[[str], Any]) -> None:
    ekf = part("ekf").Ekf()
    ekf.advance(5 * DT_NS)
    before = ekf.covariance.copy()
    ekf.advance(3 * DT_NS)
    assert ekf.stamp_ns == 5 * DT_NS
    np.testing.assert_array_equal(ekf.covariance, before)


def test_an_outlier_is_refused_and_a_good_position_taken(part: Callable[[str], Any]) -> None:
    ekf = part("ekf").Ekf()
    before = ekf.state.copy()
    assert not ekf.update_position(40.0, 0.0, 1.0, gate=5.0)
    np.testing.assert_array_equal(ekf.state, before)
    assert ekf.update_position(1.0, -1.0, 1.0, gate=5.0)
    assert ekf.update_position(40.0, 0.0, 1.0)  # no gate
    assert ekf.state[0] > 0


def test_distance_is_mahalanobis(part: Callable[[str], Any]) -> None:
    ekf = part("ekf").Ekf()
    ekf.covariance[:2, :2] = [[2.0, 0.6], [0.6, 1.0]]
    s = np.array([[2.5, 0.6], [0.6, 1.5]])
    offset = np.array([3.0, -1.0])
    expected = math.sqrt(offset @ np.linalg.inv(s) @ offset)
    assert ekf.position_distance(3.0, -1.0, 0.5) == pytest.approx(expected)


def test_heading_is_learnt_from_positions_alone(part: Callable[[str], Any]) -> None:
    """Half a radian of wrong heading goes away: the cross terms of the covariance work."""
    ekf = part("ekf").Ekf()
    ekf.set_pose(0.0, 0.0, 0.5)
    ekf.covariance[2, 2] = 0.5
    for i in range(400):
        ekf.advance(i * 5 * DT_NS)
        ekf.update_speed(1.0, 0.01)
        ekf.update_yaw_rate(0.0, 0.001)
        ekf.update_position(i * 0.05, 0.0, 0.25)
    assert abs(ekf.state[2]) < 0.03
    assert abs(ekf.state[1]) < 0.1


def test_wrap_angle(part: Callable[[str], Any]) -> None:
    wrap = part("ekf").wrap_angle
    assert wrap(-math.pi) == math.pi
    assert wrap(3 * math.pi) == pytest.approx(math.pi)

    @settings(deadline=None)
    @given(st.floats(-1000, 1000))
    def check(angle: float) -> None:
        assert -math.pi < wrap(angle) <= math.pi
        assert math.cos(wrap(angle)) == pytest.approx(math.cos(angle), abs=1e-9)

    check()


@pytest.mark.long
def test_local_frame_there_and_back(part: Callable[[str], Any]) -> None:
    frame_class = part("geodesy").LocalFrame

    @settings(deadline=None)
    @given(st.floats(-80, 80), st.floats(-180, 180), st.floats(-5e3, 5e3), st.floats(-5e3, 5e3))
    def check(latitude: float, longitude: float, east: float, north: float) -> None:
        frame = frame_class(latitude, longitude)
        assert frame.to_metres(*frame.to_degrees(east, north)) == pytest.approx(
            (east, north), abs=1e-6
        )

    check()


def test_local_frame_has_the_size_of_the_earth(part: Callable[[str], Any]) -> None:
    # A degree at 45° on WGS 84: 111,131.8 m of latitude, 78,846.8 m of longitude.
    frame = part("geodesy").LocalFrame(45.0, 7.0)
    east, north = frame.to_metres(45.001, 7.001)
    assert east == pytest.approx(78.8468, abs=1e-3)
    assert north == pytest.approx(111.1318, abs=1e-3)


@pytest.mark.few(3)
@pytest.mark.parametrize("datum", [(90.0, 0.0), (0.0, 181.0), (math.nan, 0.0)])
def test_a_datum_off_the_earth_is_refused(
    part: Callable[[str], Any], datum: tuple[float, float]
) -> None:
    with pytest.raises(ValueError, match="the datum must have"):
        part("geodesy").LocalFrame(*datum)


@pytest.mark.long
def test_alignment_finds_the_turn_and_the_shift(part: Callable[[str], Any]) -> None:
    aligner_class = part("alignment").TrackAligner

    @settings(deadline=None)
    @given(st.floats(-3.1, 3.1), st.floats(-1000, 1000), st.floats(-1000, 1000))
    def check(turn: float, x: float, y: float) -> None:
        aligner = aligner_class(9.99)
        cosine, sine = math.cos(turn), math.sin(turn)
        found = None
        for i in range(101):
            assert found is None
            local = (0.1 * i, math.sin(0.05 * i))
            world = (
                x + cosine * local[0] - sine * local[1],
                y + sine * local[0] + cosine * local[1],
            )
            found = aligner.add(local, world, 0.25)
        assert found is not None
        assert math.remainder(found.turn - turn, 2 * math.pi) == pytest.approx(0, abs=1e-6)
        assert (found.x, found.y) == pytest.approx((x, y), abs=1e-6)
        assert found.variance == pytest.approx(0.25 / 8.6, rel=0.1)  # 10² / 12, and a bit of bend

    check()


SQUARE = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]


def test_a_smooth_loop_meets_its_waypoints_at_even_spacing(part: Callable[[str], Any]) -> None:
    course = part("course")
    loop = course.smooth_loop(SQUARE, 0.1)
    gaps = [course.distance(a, b) for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)]
    assert max(gaps) < 0.102
    assert min(gaps) > 0.097
    for waypoint in SQUARE:
        assert min(course.distance(waypoint, point) for point in loop) < 0.06


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("waypoints", "spacing", "message"),
    [
        (SQUARE[:2], 0.1, "at least three waypoints, there are 2"),
        (SQUARE, 0.0, "must be above 0, is 0"),
        ([*SQUARE, (0.0, 0.0)], 0.1, "waypoint 4 and the next one"),
    ],
)
def test_senseless_loops_are_refused(
    part: Callable[[str], Any], waypoints: Any, spacing: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        part("course").smooth_loop(waypoints, spacing)


def test_a_section_runs_forwards_and_around(part: Callable[[str], Any]) -> None:
    section = part("course").section
    ring = [(float(i), 0.0) for i in range(10)]
    assert section(ring, (2.1, 0.0), (4.0, 1.0)) == ring[2:5]
    assert section(ring, (8.0, 0.0), (1.0, 0.0)) == [ring[8], ring[9], ring[0], ring[1]]
    assert section(ring, (3.0, 0.0), (3.0, 0.0)) == ring[3:] + ring[:4]


@pytest.mark.long
def test_pursuit_drives_a_lap_within_its_limits(part: Callable[[str], Any]) -> None:
    course, body = part("course"), part("unicycle").Unicycle(0.0, 0.0, 0.0)
    loop = course.smooth_loop([(0, 0), (5, -0.5), (9, 1.5), (9.5, 5.5), (3, 6)], 0.2)
    limits = course.Limits(speed=1.2, sideways=0.8, yaw_rate=1.2)
    pursuit = course.PurePursuit([*loop, loop[0]], 1.0, limits)
    furthest, steps = 0.0, 0
    while not pursuit.finished:
        speed, yaw_rate = pursuit.command(body.x, body.y, body.yaw)
        assert 0 < speed <= limits.speed
        assert abs(yaw_rate) <= limits.yaw_rate
        for _ in range(5):
            body.step(0.01, speed, yaw_rate)
        here = (body.x, body.y)
        furthest = max(furthest, min(course.distance(here, point) for point in loop))
        steps += 1
        assert steps < 2000, f"no lap within 100 s, at {here}"
    assert steps * 0.05 == pytest.approx(0.2 * len(loop) / 1.2, rel=0.15)
    assert furthest < 0.8


@pytest.mark.long
def test_an_empty_path_cannot_be_followed(part: Callable[[str], Any]) -> None:
    course = part("course")
    with pytest.raises(ValueError, match="no path to follow"):
        course.PurePursuit([], 1.0, course.Limits(1.0, 1.0, 1.0))


def test_unicycle_reaches_its_set_points_and_keeps_still_without_time(
    part: Callable[[str], Any],
) -> None:
    body = part("unicycle").Unicycle(0.0, 0.0, 0.0)
    body.step(0.0, 1.0, 1.0)
    assert (body.x, body.speed, body.yaw_rate) == (0.0, 0.0, 0.0)
    for _ in range(500):
        body.step(0.01, 1.0, 0.0)
    assert body.speed == pytest.approx(1.0, abs=1e-6)
    # Five seconds less the lag, at which an exponential approach comes out.
    assert body.x == pytest.approx(5.0 - 0.25, abs=0.01)
    assert body.y == 0.0
