"""Numeric fields of messages as curves: what makes any topic plottable, whatever its type.

The numbers that stand together in a message (x, y and z of a position) are one set of curves, at
``TOPIC/pose.pose.position``. Times and large arrays such as covariances are no curves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from rsltrace.trace.model.placeholders import NO_FIELD
from rsltrace_viewer.rerun_export.columns import lists
from rsltrace_viewer.rerun_export.messages.values import items, numbers

_ITEMS_MAX = 16
_CURVES_MAX = 32
"""More curves than this are no plot that anybody reads; the data is there all the same."""
_TIME_FIELDS = ({"sec", "nanosec"}, {"seconds", "nanoseconds"})
"""What ROS puts into a message that has no fields."""


@dataclass(frozen=True, slots=True)
class Curves:
    """Curves with one point per message: ``scalars`` has a list of values per row."""

    path: str
    names: tuple[str, ...]
    scalars: pa.Array


def curves_of(structs: pa.StructArray) -> Iterator[Curves]:
    """Yield the curves of some messages, those of the whole message first."""
    yield from _curves(structs, "")


def _curves(structs: pa.StructArray, path: str) -> Iterator[Curves]:
    names: list[str] = []
    inner: list[tuple[str, pa.Array]] = []
    for place in range(structs.type.num_fields):
        field = structs.type.field(place)
        if field.name == NO_FIELD:
            continue
        if _is_number(field.type):
            names.append(field.name)
        else:
            inner.append((field.name, structs.field(place)))
    if names and set(names) not in _TIME_FIELDS:
        shown = names[:_CURVES_MAX]
        values = np.stack([numbers(structs.field(name)) for name in shown], axis=1)
        counts = np.full(len(structs), len(shown), dtype=np.int64)
        yield Curves(path, tuple(shown), lists(counts, pa.array(values.reshape(-1))))
    for name, array in inner:
        below = f"{path}.{name}" if path else name
        if pa.types.is_struct(array.type):
            yield from _curves(array, below)
        elif pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
            yield from _array(array, below)


def _array(array: pa.Array, path: str) -> Iterator[Curves]:
    if not _is_number(array.type.value_type):
        return
    counts, values = items(array)
    most = int(np.max(counts)) if len(counts) else 0
    if 0 < most <= _ITEMS_MAX:
        names = tuple(f"[{place}]" for place in range(most))
        yield Curves(path, names, lists(counts, pa.array(numbers(values))))


def _is_number(kind: pa.DataType) -> bool:
    return bool(
        pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
    )
