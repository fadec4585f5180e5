"""Rows of messages on their way from Rerun's loader to our recording.

The chunks of a trace are cut where its events are, so those of a slow topic hold few rows each.
Rows of one kind wait here until there are enough for a chunk: faster to write, and to view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from rerun.chunk import Chunk

from rsltrace_viewer.rerun_export.columns import EVENT, SIM_TIME, Clock

_ROWS_PER_CHUNK = 8192
_BYTES_PER_CHUNK = 1 << 20

Stream = tuple[str, tuple[str, ...]]
"""A path and the columns of its rows: such rows follow each other."""

Times = tuple[tuple[str, pa.Array], ...]
LoadedColumns = tuple[tuple[pa.Field, pa.Array], ...]
"""Columns as the loader made them; the metadata of a field says which component it holds."""


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of one chunk: where they belong and what they hold."""

    topic: str
    path: str
    times: Times
    stamps_ns: npt.NDArray[np.int64]
    events: npt.NDArray[np.int64]
    columns: LoadedColumns


@dataclass(slots=True)
class Waiting:
    """Rows of one sequence that wait to become one chunk."""

    topic: str
    path: str
    rows: int = 0
    bytes: int = 0
    fields: list[pa.Field] = field(default_factory=list)
    parts: list[list[pa.Array]] = field(default_factory=list)
    stamps_ns: list[npt.NDArray[np.int64]] = field(default_factory=list)
    events: list[npt.NDArray[np.int64]] = field(default_factory=list)

    def add(
        self,
        columns: LoadedColumns,
        stamps_ns: npt.NDArray[np.int64],
        events: npt.NDArray[np.int64],
    ) -> None:
        """Take over rows with the same columns as those before."""
        self.fields = [f for f, _ in columns]
        self.parts.append([column for _, column in columns])
        self.stamps_ns.append(stamps_ns)
        self.events.append(events)
        self.rows += len(stamps_ns)
        self.bytes += sum(column.nbytes for _, column in columns)

    @property
    def full(self) -> bool:
        """Whether it is time to make a chunk of them."""
        return self.rows >= _ROWS_PER_CHUNK or self.bytes >= _BYTES_PER_CHUNK

    def joined(self, clock: Clock) -> Rows:
        """Return all rows."""
        if len(self.parts) == 1:
            arrays = self.parts[0]
        else:
            arrays = [pa.concat_arrays(list(parts)) for parts in zip(*self.parts, strict=True)]
        stamps = np.concatenate(self.stamps_ns)
        events = np.concatenate(self.events)
        times = ((SIM_TIME, clock.array(stamps)), (EVENT, pa.array(events)))
        columns = tuple(zip(self.fields, arrays, strict=True))
        return Rows(self.topic, self.path, times, stamps, events, columns)


def loaded_columns(batch: pa.RecordBatch) -> LoadedColumns:
    """Return the columns of a loaded chunk that are data, not times or numbers of rows."""
    return tuple(
        (f, batch.column(place))
        for place, f in enumerate(batch.schema)
        if (f.metadata or {}).get(b"rerun:kind") == b"data"
    )


def loaded_chunk(
    path: str, times: Times, columns: Sequence[tuple[pa.Field, pa.Array]]
) -> list[Chunk]:
    """Return loaded columns as the chunk (a list of one) of another entity, at our times."""
    fields = [pa.field(name, values.type) for name, values in times]
    fields += [f for f, _ in columns]
    batch = pa.RecordBatch.from_arrays(
        [values for _, values in (*times, *columns)], schema=pa.schema(fields)
    )
    index = [name for name, _ in times] or None
    chunks: list[Chunk] = Chunk.from_record_batch(batch, index=index, entity_path=path)
    return chunks
