"""Messages as Arrow gives them, taken apart: the fields of many messages as one numpy array.

Rerun's reader hands out every message of a type it does not draw as one Arrow struct. A message's
fields are found by dotted paths; sequences keep how many items each message has.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa


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
