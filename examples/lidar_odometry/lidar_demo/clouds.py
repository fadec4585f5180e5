"""Between point clouds of ROS and arrays."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField

Array = NDArray[np.float64]
_XYZ = ("x", "y", "z")
_TIME = "time"


def cloud_of(frame_id: str, stamp: Time, points: Array, times: Array | None = None) -> PointCloud2:
    """Return a cloud of ``points``, shape (n, 3) in metres, with the time of each in seconds after
    the sweep began, if there are ``times``."""
    names = _XYZ if times is None else (*_XYZ, _TIME)
    columns = points if times is None else np.column_stack([points, times])
    cloud = PointCloud2()
    cloud.header.frame_id = frame_id
    cloud.header.stamp = stamp
    cloud.height, cloud.width = 1, len(points)
    cloud.fields = [
        PointField(name=name, offset=4 * at, datatype=PointField.FLOAT32, count=1)
        for at, name in enumerate(names)
    ]
    cloud.point_step = 4 * len(names)
    cloud.row_step = cloud.point_step * cloud.width
    cloud.is_dense = True
    cloud.data = columns.astype("<f4").tobytes()
    return cloud


def points_of(cloud: PointCloud2) -> tuple[Array, Array]:
    """Return a cloud's points, shape (n, 3), and their times, shape (n,); none: empty."""
    offsets = {field.name: field.offset for field in cloud.fields}
    names = [name for name in (*_XYZ, _TIME) if name in offsets]
    kind = np.dtype(
        {
            "names": names,
            "formats": ["<f4"] * len(names),
            "offsets": [offsets[name] for name in names],
            "itemsize": cloud.point_step,
        }
    )
    rows = np.frombuffer(bytes(cloud.data), dtype=kind)
    points = np.column_stack([rows[name] for name in _XYZ]).astype(np.float64)
    return points, rows[_TIME].astype(np.float64) if _TIME in names else np.empty(0)


def set_pose(pose: Pose, matrix: Array) -> None:
    """Give a message the pose of a 4×4 matrix."""
    place = pose.position
    place.x, place.y, place.z = (float(value) for value in matrix[:3, 3])
    turn = pose.orientation
    turn.x, turn.y, turn.z, turn.w = _quaternion(matrix[:3, :3])


def matrix_of(pose: Pose) -> Array:
    """Return the 4×4 matrix of a pose."""
    turn = pose.orientation
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = [pose.position.x, pose.position.y, pose.position.z]
    return matrix


def planar(position: Array, yaw: float) -> Array:
    """Return the 4×4 matrix of a place (3,) and a heading in radians."""
    matrix = np.eye(4)
    c, s = np.cos(yaw), np.sin(yaw)
    matrix[:2, :2] = [[c, -s], [s, c]]
    matrix[:3, 3] = position
    return matrix


def _quaternion(r: Array) -> tuple[float, float, float, float]:
    """Return (x, y, z, w) of a rotation; the greatest of the four is found first, for accuracy."""
    squares = [
        1 + r[0, 0] - r[1, 1] - r[2, 2],
        1 - r[0, 0] + r[1, 1] - r[2, 2],
        1 - r[0, 0] - r[1, 1] + r[2, 2],
        1 + r[0, 0] + r[1, 1] + r[2, 2],
    ]
    at = int(np.argmax(squares))
    s = 2 * float(np.sqrt(squares[at]))
    skew = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    if at == 3:
        x, y, z, w = skew[0] / s, skew[1] / s, skew[2] / s, s / 4
    else:
        found = [(r[i, at] + r[at, i]) / s for i in range(3)]
        found[at] = s / 4
        x, y, z = found
        w = skew[at] / s
    return float(x), float(y), float(z), float(w)
