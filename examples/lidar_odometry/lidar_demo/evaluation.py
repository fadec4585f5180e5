"""How far the odometry is from the truth, by evo: metrics of the job, of any trace of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from rsltrace import Trace

ESTIMATE, TRUTH = "/odom", "/ground_truth"


def trajectories(trace: Trace) -> tuple[Any, Any] | None:
    """Return truth and estimate as evo's trajectories: poses of the same sweeps, the estimate laid
    on the truth (Umeyama, without scaling). None if fewer than three sweeps were registered."""
    from evo.core.sync import associate_trajectories

    truth, estimate = _trajectory(trace, TRUTH), _trajectory(trace, ESTIMATE)
    if truth is None or estimate is None:
        return None
    truth, estimate = associate_trajectories(truth, estimate, max_diff=1e-6)
    estimate.align(truth)
    return truth, estimate


def absolute_error(trace: Trace) -> float | None:
    """Return the absolute pose error: the root mean square of the distance to the truth, mm."""
    from evo.core.metrics import APE, PoseRelation

    return _error(APE(PoseRelation.translation_part), trace)


def relative_error(trace: Trace) -> float | None:
    """Return the relative pose error in mm: the root mean square over stretches of a metre. None if
    the way is shorter."""
    from evo.core.filters import FilterException
    from evo.core.metrics import RPE, PoseRelation, Unit

    metric = RPE(PoseRelation.translation_part, delta=1.0, delta_unit=Unit.meters, all_pairs=True)
    try:
        return _error(metric, trace)
    except FilterException:
        return None


def _error(metric: Any, trace: Trace) -> float | None:
    from evo.core.metrics import StatisticsType

    both = trajectories(trace)
    if both is None:
        return None
    metric.process_data(both)
    return 1000.0 * float(metric.get_statistic(StatisticsType.rmse))


def lost_sweeps(trace: Trace) -> float:
    """Return how many sweeps the odometry has not registered."""
    return sum(1 for _ in trace.messages(TRUTH)) - sum(1 for _ in trace.messages(ESTIMATE))


def _trajectory(trace: Trace, topic: str) -> Any:
    from evo.core.trajectory import PoseTrajectory3D

    stamps, places, turns = [], [], []
    for _, _, data in trace.messages(topic):
        said: Any = trace.decode(topic, data)
        stamp, pose = said.header.stamp, said.pose.pose
        stamps.append(stamp.sec + stamp.nanosec * 1e-9)
        places.append([pose.position.x, pose.position.y, pose.position.z])
        turn = pose.orientation
        turns.append([turn.w, turn.x, turn.y, turn.z])
    if len(stamps) < 3:
        return None
    return PoseTrajectory3D(np.array(places), np.array(turns), np.array(stamps))
