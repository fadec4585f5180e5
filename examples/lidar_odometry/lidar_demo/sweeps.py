"""Real sweeps from PLY files, played as a LiDAR's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Empty

from lidar_demo.clouds import Array, cloud_of

PERIOD_S = 0.1
_TYPES = {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4"}
_TYPES |= {"uint": "<u4", "float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8"}


class SweepPlayer(Node):
    """Publishes a file of ``files`` in ``folder`` on /points every 0.1 s, then /finished.

    The files have no times of their points, so nothing can be deskewed.
    """

    def __init__(self) -> None:
        super().__init__("sweeps")
        folder = Path(str(self.declare_parameter("folder", ".").value))
        files = list(self.declare_parameter("files", [""]).value)
        self._sweeps = [read_ply(folder / name) for name in files]
        self._points = self.create_publisher(PointCloud2, "points", qos_profile_sensor_data)
        self._finished = self.create_publisher(Empty, "finished", 1)
        self.create_timer(PERIOD_S, self._on_timer)

    def _on_timer(self) -> None:
        if self._sweeps:
            stamp = self.get_clock().now().to_msg()
            self._points.publish(cloud_of("lidar", stamp, self._sweeps.pop(0)))
        else:
            self._finished.publish(Empty())


def read_ply(path: Path) -> Array:
    """Return the points of a binary PLY file, shape (n, 3) in metres.

    :raises ValueError: it is another kind of file, or shorter than it says.
    """
    content = path.read_bytes()
    head, end, rows = content.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not end or lines[:1] != [["ply"]] or ["format", "binary_little_endian", "1.0"] not in lines:
        raise ValueError(f"{path} is no binary PLY file (little endian)")
    elements = [line for line in lines if line[:1] == ["element"]]
    fields = [(line[2], _TYPES.get(line[1])) for line in lines if line[:1] == ["property"]]
    if len(elements) != 1 or elements[0][1] != "vertex" or None in dict(fields).values():
        raise ValueError(f"{path} has something else than points")
    if not {"x", "y", "z"} <= dict(fields).keys():
        raise ValueError(f"{path} has points without x, y and z")
    kind, count = np.dtype(fields), int(elements[0][2])
    if len(rows) < count * kind.itemsize:
        raise ValueError(f"{path} ends within its points")
    points = np.frombuffer(rows, dtype=kind, count=count)
    return np.column_stack([points[axis] for axis in "xyz"]).astype(np.float64)
