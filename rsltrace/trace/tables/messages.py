"""The decoded messages of a topic as record batches, one column per field."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype

from rsltrace.errors import TraceError, did_you_mean
from rsltrace.trace.cdr import WIDE_TEXT_TYPE
from rsltrace.trace.decode import Decoder
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.model.event import NO_SEQUENCE, Output, OutputKind
from rsltrace.trace.model.texts import NO_FIELD
from rsltrace.trace.tables.rows import (
    TableInput,
    TextDictionary,
    TraceTable,
    node_names,
    whole_numbers,
)

_ROWS_PER_BATCH = 4096
_BYTES_PER_BATCH = 16 << 20
_FIELDS_MAX = 10_000
_OWN = ("stamp_ns", "event", "node", "sequence")
_SENT = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG)
_NAMES = {"float32": "float32", "float64": "float64", "bool": "bool_", "string": "string"}
_BYTES = {"byte": "uint8", "char": "uint8"}
_ARRAYS = (Nodetype.ARRAY, Nodetype.SEQUENCE)


class _MessageColumn(NamedTuple):
    """A field by its path, with its description from the schema."""

    path: str
    description: Any


def message_table(
    trace: TableInput,
    decoder_of: Callable[[ChannelInfo], Decoder],
    topic: str,
    fields: Sequence[str] | None,
    type_name: str | None,
) -> TraceTable:
    """Return the messages of a topic as a table. Raises TraceError for unknown ones."""
    channel = _channel(trace, topic, type_name)
    try:
        decoder = decoder_of(channel)
    except TraceError as error:
        raise TraceError(f"{trace.name}: {error}") from error
    chosen = _selected_columns(trace, decoder, topic, fields)

    def make(arrow: Any) -> tuple[Any, Iterator[Any]]:
        nodes = TextDictionary(arrow, node_names(trace.entities))
        whole = arrow.int64()
        types = [_arrow_type(arrow, decoder, field.description) for field in chosen]
        own = zip(_OWN, (whole, whole, nodes.type, arrow.uint32()), strict=True)
        # A message field may have the name of an own column, which then gets an underscore.
        named = [(f"_{name}" if name in {f.path for f in chosen} else name, t) for name, t in own]
        schema = arrow.schema(
            [*named, *((field.path, t) for field, t in zip(chosen, types, strict=True))]
        )
        return schema, _batches(arrow, schema, trace, channel, decoder, chosen, nodes)

    return TraceTable(make)


def _batches(
    arrow: Any,
    schema: Any,
    trace: TableInput,
    channel: ChannelInfo,
    decoder: Decoder,
    chosen: Sequence[_MessageColumn],
    nodes: TextDictionary,
) -> Iterator[Any]:
    senders = _Senders(trace, channel)
    getters = [attrgetter(field.path) for field in chosen]
    plain = [_as_arrow(decoder, field.description) for field in chosen]
    types = [schema.field(len(_OWN) + n).type for n in range(len(chosen))]
    stamps: list[int] = []
    sequences: list[int] = []
    values: list[list[Any]] = [[] for _ in chosen]
    size = 0

    def batch() -> Any:
        numbers = np.array(sequences, dtype=np.uint32)
        events, owners = senders.of(numbers)
        columns = [
            arrow.array(whole_numbers(trace, np.array(stamps, dtype=np.uint64))),
            arrow.array(events, mask=events < 0),
            nodes.of(owners),
            arrow.array(numbers),
            *(arrow.array(column, t) for column, t in zip(values, types, strict=True)),
        ]
        return arrow.record_batch(columns, schema=schema)

    for _, stamp_ns, sequence, data in trace.messages_of(frozenset((channel.id,))):
        try:
            message = decoder.decode(data)
        except TraceError as error:
            raise TraceError(f"{trace.name}: {error}") from error
        stamps.append(stamp_ns)
        sequences.append(sequence)
        for column, get, convert in zip(values, getters, plain, strict=True):
            value = get(message)
            column.append(value if convert is None else convert(value))
        size += len(data)
        if len(stamps) >= _ROWS_PER_BATCH or size >= _BYTES_PER_BATCH:
            yield batch()
            for kept in (stamps, sequences, *values):
                kept.clear()
            size = 0
    if stamps:
        yield batch()


class _Senders:
    """By the number of a channel's message: its event and its sender."""

    def __init__(self, trace: TableInput, channel: ChannelInfo) -> None:
        sent = {
            (kind.value, entity)
            for entity in trace.entities
            for kind in _SENT
            if trace.channel_of(Output(0, entity, kind, 0, NO_SEQUENCE)) == channel
        }
        kinds = [np.array(sorted(e for k, e in sent if k == kind), np.uint32) for kind in _SENT]
        found: list[npt.NDArray[np.void]] = []
        for outputs in trace.outputs():
            own = np.zeros(len(outputs), dtype=bool)
            for kind, entities in zip(_SENT, kinds, strict=True):
                if len(entities):
                    own |= (outputs["kind"] == kind) & np.isin(outputs["entity"], entities)
            found.append(outputs[own & (outputs["sequence"] != NO_SEQUENCE)])
        # A message may be an output twice: as a log record and as a published message.
        rows = np.concatenate(found) if found else np.zeros(0, [("sequence", "<u4")])
        self._sequences, first = np.unique(rows["sequence"], return_index=True)
        self._rows = rows[first]

    def of(
        self, sequences: npt.NDArray[np.uint32]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.uint32]]:
        """Return the events of messages (-1: none) and the ids of their senders."""
        if not len(self._rows):
            nobody = np.full(len(sequences), NO_SEQUENCE, dtype=np.uint32)
            return np.full(len(sequences), -1, dtype=np.int64), nobody
        places = np.searchsorted(self._sequences, sequences)
        places[places == len(self._sequences)] = 0
        missing = self._sequences[places] != sequences
        events = self._rows["event"][places].astype(np.int64)
        owners = self._rows["entity"][places].astype(np.uint32)
        events[missing], owners[missing] = -1, NO_SEQUENCE
        return events, owners


def _channel(trace: TableInput, topic: str, type_name: str | None) -> ChannelInfo:
    found = [channel for channel in trace.channels.values() if channel.topic == topic]
    if not found:
        topics = {channel.topic for channel in trace.channels.values()}
        raise TraceError(f"{trace.name} has no topic {topic}{did_you_mean(topic, topics)}")
    types = [channel.type for channel in found]
    if type_name is None and len(found) > 1:
        raise TraceError(
            f"{trace.name}: {topic} has messages of several types; name one with type=: "
            f"{', '.join(types)}"
        )
    wanted = [channel for channel in found if type_name in (None, channel.type)]
    if not wanted:
        near = did_you_mean(type_name or "", types)
        raise TraceError(f"{trace.name}: {topic} has no messages of {type_name}{near}")
    return wanted[0]


def _selected_columns(
    trace: TableInput, decoder: Decoder, topic: str, fields: Sequence[str] | None
) -> list[_MessageColumn]:
    """Return the columns for the requested fields, in order."""
    if isinstance(fields, str):
        fields = [fields]
    if (count := _count(decoder, decoder.name, {})) > _FIELDS_MAX:
        raise TraceError(f"{trace.name}: the messages on {topic} have {count} fields")
    every = list(_leaves(decoder, "", decoder.name))
    if fields is None:
        return every
    chosen: dict[str, _MessageColumn] = {}
    for wanted in fields:
        found = [one for one in every if f"{one.path}.".startswith(f"{wanted}.")]
        if not found:
            near = did_you_mean(wanted, [one.path for one in every])
            raise TraceError(f"{trace.name}: messages on {topic} have no field {wanted}{near}")
        chosen.update((one.path, one) for one in found)
    return list(chosen.values())


def _count(decoder: Decoder, interface: str, known: dict[str, int]) -> int:
    """Return the number of fields of an interface, nested ones included."""
    if interface not in known:
        kinds = [d[0] if k in _ARRAYS else (k, d) for _, (k, d) in decoder.types[interface][1]]
        known[interface] = sum(
            1 + (_count(decoder, str(detail), known) if kind == Nodetype.NAME else 0)
            for kind, detail in kinds
        )
    return known[interface]


def _leaves(decoder: Decoder, prefix: str, interface: str) -> Iterator[_MessageColumn]:
    """Yield the fields of an interface, with those of nested messages in their place."""
    for name, description in decoder.types[interface][1]:
        kind, detail = description
        if name == NO_FIELD:
            continue
        if kind == Nodetype.NAME and detail != WIDE_TEXT_TYPE:
            yield from _leaves(decoder, f"{prefix}{name}.", str(detail))
        else:
            yield _MessageColumn(f"{prefix}{name}", description)


def _arrow_type(arrow: Any, decoder: Decoder, description: Any) -> Any:
    kind, detail = description
    if kind == Nodetype.BASE:
        base = _BYTES.get(detail[0], detail[0])
        return getattr(arrow, _NAMES.get(base, base))()
    if kind == Nodetype.NAME:
        if detail == WIDE_TEXT_TYPE:
            return arrow.string()
        inner = [
            arrow.field(name, _arrow_type(arrow, decoder, one))
            for name, one in decoder.types[str(detail)][1]
            if name != NO_FIELD
        ]
        return arrow.struct(inner)
    return arrow.list_(_arrow_type(arrow, decoder, detail[0]))


def _as_arrow(decoder: Decoder, description: Any) -> Callable[[Any], Any] | None:
    """Return a function that converts a decoded value for Arrow; None if it needs none."""
    kind, detail = description
    if kind == Nodetype.NAME and detail != WIDE_TEXT_TYPE:
        inner = [
            (name, _as_arrow(decoder, one))
            for name, one in decoder.types[str(detail)][1]
            if name != NO_FIELD
        ]
        return lambda value: {
            name: getattr(value, name) if convert is None else convert(getattr(value, name))
            for name, convert in inner
        }
    if kind in _ARRAYS and detail[0][0] == Nodetype.NAME:
        item = _as_arrow(decoder, detail[0])
        return None if item is None else lambda values: [item(value) for value in values]
    return None
