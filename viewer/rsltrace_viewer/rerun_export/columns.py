"""Chunks for Rerun, built from whole columns: a call per ten thousand rows, not one per row.

Rerun takes Arrow record batches whose field metadata says which component a column holds. Building
them here keeps texts as Arrow arrays all the way, which its own column helpers turn into lists.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

if TYPE_CHECKING:
    from rerun import ComponentDescriptor

Column = tuple["ComponentDescriptor | str", pa.Array]
"""A component (or the name of one of ours) with its values: one per row, or a list per row."""

SIM_TIME = "sim_time"
EVENT = "event"
_INT64_MAX = 2**63 - 1


@dataclass(frozen=True, slots=True)
class Clock:
    """How simulated time is shown: as a date where it is one, else as the time since zero."""

    dated: bool

    @property
    def timeline_type(self) -> str:
        """The name Rerun's MCAP reader has for it."""
        return "timestamp_ns" if self.dated else "duration_ns"

    def array(self, stamps_ns: npt.NDArray[Any]) -> pa.Array:
        """Return stamps (any integers, nanoseconds, shape (n,)) as the ``sim_time`` column."""
        clipped = np.minimum(stamps_ns, np.asarray(_INT64_MAX, dtype=stamps_ns.dtype))
        kind = pa.timestamp("ns") if self.dated else pa.duration("ns")
        return pa.array(clipped.astype(np.int64)).cast(kind)


_DATES_FROM_NS = 315_532_800 * 1_000_000_000
"""1980. A simulation starts near zero; what is recorded on a robot has the time of day."""


def clock_for(start_ns: Sequence[int]) -> Clock:
    """Return how to show the time of runs that started then: as dates if one of them began so."""
    return Clock(dated=any(start >= _DATES_FROM_NS for start in start_ns))


def make_chunk(
    path: str,
    times: Sequence[tuple[str, pa.Array]],
    columns: Sequence[Column],
) -> list[Chunk]:
    """Return the chunk (as a list of one) of an entity; without ``times`` it is static."""
    fields = [pa.field(name, values.type) for name, values in times]
    fields += [_field(component, values) for component, values in columns]
    batch = pa.RecordBatch.from_arrays(
        [values for _, values in (*times, *columns)], schema=pa.schema(fields)
    )
    index = [name for name, _ in times] or None
    chunks: list[Chunk] = Chunk.from_record_batch(batch, index=index, entity_path=path)
    return chunks


def lane_colours(path: str, colours: Mapping[str, int]) -> list[Chunk]:
    """Return the chunk that gives the states of a lane their colours (0xRRGGBBAA)."""
    one = np.array([len(colours)])
    configuration = rr.StateConfiguration
    paints = pa.array(colours.values(), type=pa.uint32())
    return make_chunk(
        path,
        (),
        (
            (configuration.descriptor_values(), lists(one, pa.array(colours))),
            (configuration.descriptor_colors(), lists(one, paints)),
        ),
    )


def _field(component: ComponentDescriptor | str, values: pa.Array) -> pa.Field:
    if isinstance(component, str):
        return pa.field(component, values.type)
    metadata = {
        "rerun:component": component.component,
        "rerun:archetype": component.archetype or "",
        "rerun:component_type": component.component_type or "",
        "rerun:kind": "data",
    }
    return pa.field(component.component, values.type, metadata=metadata)


def lists(counts: npt.NDArray[np.integer[Any]], values: pa.Array) -> pa.Array:
    """Return ``values`` cut into lists of ``counts`` items (shape (rows,)) each."""
    offsets = np.zeros(len(counts) + 1, dtype=np.int32)
    np.cumsum(counts, out=offsets[1:])
    return pa.ListArray.from_arrays(pa.array(offsets), values)


def strip_lists(counts: npt.NDArray[np.integer[Any]], points: pa.Array) -> pa.Array:
    """Return ``points`` cut into strips of ``counts`` points; a strip has no missing points."""
    strips = lists(counts, points)
    kind = pa.list_(pa.field("item", points.type, nullable=False))
    return pa.ListArray.from_arrays(strips.offsets, points, type=kind)


def vectors(values: npt.NDArray[np.floating[Any]]) -> pa.Array:
    """Return an array of shape (n, k) as n lists of k float32, as Rerun has positions."""
    size = values.shape[1]
    flat = pa.array(np.ascontiguousarray(values, dtype=np.float32).reshape(-1))
    kind = pa.list_(pa.field("item", pa.float32(), nullable=False), size)
    return pa.FixedSizeListArray.from_arrays(flat, type=kind)


def constant(value: Any, rows: int, kind: pa.DataType | None = None) -> pa.Array:
    """Return ``value`` in every row."""
    return pa.repeat(pa.scalar(value, type=kind), rows)
