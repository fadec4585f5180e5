"""Events, outputs and entities as record batches: the rows of a segment become columns.

A segment is stored by rows, Arrow needs columns: each is copied once. Names and kinds are
dictionary-encoded, so each row has one number for them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from rsltrace.errors import SetupError, TraceError
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import (
    NO_EVENT,
    NO_SEQUENCE,
    EventFlag,
    EventKind,
    Output,
    OutputKind,
)

if TYPE_CHECKING:
    from rsltrace.trace.index import ChannelInfo

# A table whose rows are read when needed: for Arrow, pandas, or as a stream.


Makers = Callable[[Any], tuple[Any, Iterator[Any]]]
"""Given pyarrow, returns the schema of a table and its rows as record batches."""


class TraceTable:
    """A table of a trace. Each use reads the trace again, which must still be open.

    Libraries with Arrow's PyCapsule interface accept it: ``polars.DataFrame(table)``.
    """

    def __init__(self, make: Makers) -> None:
        self._make = make

    def to_arrow(self) -> Any:
        """Return a ``pyarrow.Table`` with one chunk per segment.

        Each column is copied once. Raises SetupError without pyarrow, TraceError where the trace is
        damaged.
        """
        arrow = _arrow()
        schema, batches = self._make(arrow)
        return arrow.Table.from_batches(list(batches), schema)

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``: integers stay integers, also beside nulls; texts are
        categories. Raises SetupError without pandas or pyarrow."""
        arrow = _arrow()
        try:
            import pandas
        except ImportError:
            raise _missing("pandas") from None
        table = self.to_arrow()
        numbers = {
            arrow.int64(): pandas.Int64Dtype(),
            arrow.uint64(): pandas.UInt64Dtype(),
            arrow.uint32(): pandas.UInt32Dtype(),
        }
        # pandas converts integers beside nulls to floats, which rounds hashes.
        columns = {
            name: table[name].to_pandas(
                types_mapper=numbers.get if table[name].null_count else None
            )
            for name in table.column_names
        }
        return pandas.DataFrame(columns, copy=False)

    def to_reader(self) -> Any:
        """Return a ``pyarrow.RecordBatchReader``, which reads one segment at a time."""
        arrow = _arrow()
        return arrow.RecordBatchReader.from_batches(*self._make(arrow))

    def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
        """Pass the rows to another library as a stream."""
        return self.to_reader().__arrow_c_stream__(requested_schema)


def _arrow() -> Any:
    try:
        import pyarrow
    except ImportError:
        raise _missing("pyarrow") from None
    return pyarrow


def _missing(package: str) -> SetupError:
    return SetupError(f"tables need {package}: pip install 'rsltrace[tables]'")


_WHOLE_MAX = np.uint64(2**63 - 1)


class TableInput(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def entities(self) -> dict[int, Entity]: ...
    @property
    def channels(self) -> Mapping[int, ChannelInfo]: ...
    def events(self, first: int = 0, last: int | None = None) -> Iterator[npt.NDArray[np.void]]: ...
    def outputs(
        self, first: int = 0, last: int | None = None
    ) -> Iterator[npt.NDArray[np.void]]: ...
    def channel_of(self, output: Output) -> ChannelInfo | None: ...
    def messages_of(self, channels: frozenset[int]) -> Iterator[tuple[int, int, int, bytes]]: ...


class TextDictionary:
    """Texts shared by many rows, in Arrow's dictionary encoding."""

    def __init__(self, arrow: Any, texts: Mapping[int, str | None]) -> None:
        """``texts`` maps numbers to texts; missing numbers and None become null."""
        known = dict.fromkeys(text for text in texts.values() if text is not None)
        places = {text: place for place, text in enumerate(known)}
        self._arrow = arrow
        self._texts = arrow.array(list(known), arrow.string())
        self._places = np.full(max(texts, default=0) + 2, -1, dtype=np.int32)
        for number, text in texts.items():
            if text is not None:
                self._places[number] = places[text]
        self.type = arrow.dictionary(arrow.int32(), arrow.string())

    def of(self, numbers: npt.NDArray[np.unsignedinteger]) -> Any:
        places = self._places[np.minimum(numbers, len(self._places) - 1)]
        indices = self._arrow.array(places, mask=places < 0)
        return self._arrow.DictionaryArray.from_arrays(indices, self._texts)


def node_names(entities: Mapping[int, Entity]) -> dict[int, str | None]:
    """Return the names of the entities' nodes; None for the run."""
    nodes = {e.id: entities.get(e.node) for e in entities.values()}
    return {number: node.name if node and node.id else None for number, node in nodes.items()}


def event_table(trace: TableInput, first: int, last: int | None) -> TraceTable:
    def make(arrow: Any) -> tuple[Any, Iterator[Any]]:
        whole, hashes, number = arrow.int64(), arrow.uint64(), arrow.uint32()
        entities = trace.entities
        kinds = TextDictionary(arrow, {kind.value: kind.label for kind in EventKind})
        nodes = TextDictionary(arrow, node_names(entities))
        names = TextDictionary(arrow, {e.id: e.name or None for e in entities.values()})
        schema = arrow.schema(
            {
                "index": whole,
                "stamp_ns": whole,
                "kind": kinds.type,
                "node": nodes.type,
                "name": names.type,
                "entity": number,
                "cause_event": whole,
                "cause_output": number,
                "outputs": number,
                "raised": arrow.bool_(),
                "suspended": arrow.bool_(),
                "input_hash": hashes,
                "output_hash": hashes,
                "state_hash": hashes,
                "chain_hash": hashes,
            }
        )

        def batch(events: npt.NDArray[np.void]) -> Any:
            check_kinds(trace, events["kind"], EventKind)
            flags, no_cause = events["flags"], events["cause_event"] == np.uint64(NO_EVENT)
            columns = [
                arrow.array(whole_numbers(trace, events["index"])),
                arrow.array(whole_numbers(trace, events["stamp"])),
                kinds.of(events["kind"]),
                nodes.of(events["entity"]),
                names.of(events["entity"]),
                arrow.array(_column(events, "entity")),
                arrow.array(events["cause_event"].astype(np.int64), mask=no_cause),
                arrow.array(_column(events, "cause_output"), mask=no_cause),
                arrow.array(_column(events, "outputs")),
                arrow.array(flags & np.uint8(EventFlag.RAISED) != 0),
                arrow.array(flags & np.uint8(EventFlag.SUSPENDED) != 0),
                arrow.array(_column(events, "input_hash")),
                arrow.array(_column(events, "output_hash")),
                arrow.array(_column(events, "state_hash"), mask=events["state_hash"] == 0),
                arrow.array(_column(events, "chain_hash")),
            ]
            return arrow.record_batch(columns, schema=schema)

        return schema, map(batch, trace.events(first, last))

    return TraceTable(make)


def output_table(trace: TableInput, first: int, last: int | None) -> TraceTable:
    def make(arrow: Any) -> tuple[Any, Iterator[Any]]:
        whole, number = arrow.int64(), arrow.uint32()
        entities = trace.entities
        kinds = TextDictionary(arrow, {kind.value: kind.label for kind in OutputKind})
        nodes = TextDictionary(arrow, node_names(entities))
        names = TextDictionary(arrow, {e.id: e.name or None for e in entities.values()})
        types = TextDictionary(arrow, {e.id: e.type or None for e in entities.values()})
        schema = arrow.schema(
            {
                "event": whole,
                "stamp_ns": whole,
                "kind": kinds.type,
                "node": nodes.type,
                "name": names.type,
                "type": types.type,
                "entity": number,
                "sequence": number,
                "hash": arrow.uint64(),
            }
        )

        def batch(pair: tuple[npt.NDArray[np.void], npt.NDArray[np.void]]) -> Any:
            events, outputs = pair
            check_kinds(trace, outputs["kind"], OutputKind)
            owners = (outputs["event"] - events["index"][0]).astype(np.intp)
            sequences = _column(outputs, "sequence")
            columns = [
                arrow.array(whole_numbers(trace, outputs["event"])),
                arrow.array(whole_numbers(trace, events["stamp"])[owners]),
                kinds.of(outputs["kind"]),
                nodes.of(outputs["entity"]),
                names.of(outputs["entity"]),
                types.of(outputs["entity"]),
                arrow.array(_column(outputs, "entity")),
                arrow.array(sequences, mask=sequences == NO_SEQUENCE),
                arrow.array(_column(outputs, "hash")),
            ]
            return arrow.record_batch(columns, schema=schema)

        pairs = zip(trace.events(first, last), trace.outputs(first, last), strict=True)
        return schema, map(batch, pairs)

    return TraceTable(make)


def entity_table(trace: TableInput) -> TraceTable:
    def make(arrow: Any) -> tuple[Any, Iterator[Any]]:
        entities = list(trace.entities.values())
        nodes = node_names(trace.entities)
        columns: dict[str, tuple[Any, Sequence[Any]]] = {
            "entity": (arrow.uint32(), [e.id for e in entities]),
            "kind": (arrow.string(), [e.kind.label for e in entities]),
            "node": (arrow.string(), [nodes[e.id] for e in entities]),
            "name": (arrow.string(), [e.name for e in entities]),
            "type": (arrow.string(), [e.type for e in entities]),
            "created_ns": (arrow.uint64(), [e.created_ns for e in entities]),
            "source": (arrow.string(), [e.source for e in entities]),
            "detail": (arrow.string(), [json.dumps(e.detail) for e in entities]),
        }
        schema = arrow.schema([(name, kind) for name, (kind, _) in columns.items()])
        arrays = [arrow.array(values, kind) for kind, values in columns.values()]
        return schema, iter([arrow.record_batch(arrays, schema=schema)])

    return TraceTable(make)


def whole_numbers(trace: TableInput, values: npt.NDArray[np.uint64]) -> npt.NDArray[np.int64]:
    """Return indexes or stamps as signed integers, which can be subtracted."""
    if len(values) and values.max() > _WHOLE_MAX:
        raise TraceError(f"{trace.name}: an event is later than any time of ROS")
    return values.astype(np.int64)


def check_kinds(
    trace: TableInput, values: npt.NDArray[np.unsignedinteger], known: type[IntEnum]
) -> None:
    """Raise TraceError for a kind that this version does not know."""
    unknown = set(np.unique(values).tolist()) - {kind.value for kind in known}
    if unknown:
        raise TraceError(
            f"{trace.name}: {min(unknown)} is not a valid {known.__name__}; a newer rsltrace wrote "
            "this trace"
        )


def _column(rows: npt.NDArray[np.void], name: str) -> npt.NDArray[Any]:
    column: npt.NDArray[Any] = np.ascontiguousarray(rows[name])
    return column
