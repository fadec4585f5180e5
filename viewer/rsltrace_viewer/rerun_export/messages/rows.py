"""Rows of messages on their way from Rerun's loader to our recording.

The chunks of a trace are cut where its events are, so those of a slow topic hold few rows each.
Rows of one kind wait here until there are enough for a chunk: faster to write, and to view.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from rosbags.interfaces import Nodetype

from rsltrace.errors import TraceError
from rsltrace.trace.decode import Decoders
from rsltrace.trace.model.texts import NO_FIELD
from rsltrace.trace.reader import Trace
from rsltrace_viewer.rerun_export.columns import Clock, Times, lists
from rsltrace_viewer.rerun_export.messages.shapes import items, numbers

# Numeric fields of messages as curves: what makes any topic plottable, whatever its type.
#
# The numbers that stand together in a message (x, y and z of a position) are one set of curves, at
# ``TOPIC/pose.pose.position``. Times, large arrays such as covariances and the layout of arrays are
# no curves.

_ITEMS_MAX = 16
_CURVES_MAX = 32
"""More curves than this are no plot that anybody reads; the data is there all the same."""
_NO_CURVES = ({"sec", "nanosec"}, {"seconds", "nanoseconds"}, {"data_offset"})
"""The numbers of a time, a duration, and a ``MultiArrayLayout``."""


@dataclass(frozen=True, slots=True)
class Curves:
    """Curves with one point per message: ``scalars`` has a list of values per row.

    What is ``discrete`` (switches, counts, enumerations) has no values between two messages.
    """

    path: str
    names: tuple[str, ...]
    scalars: pa.Array
    discrete: bool = False


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
    if names and set(names) not in _NO_CURVES:
        shown = names[:_CURVES_MAX]
        values = np.stack([numbers(structs.field(name)) for name in shown], axis=1)
        counts = np.full(len(structs), len(shown), dtype=np.int64)
        discrete = not any(_is_floating(structs.type.field(name).type) for name in shown)
        yield Curves(path, tuple(shown), lists(counts, pa.array(values.reshape(-1))), discrete)
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
        discrete = not _is_floating(array.type.value_type)
        yield Curves(path, names, lists(counts, pa.array(numbers(values))), discrete)


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_boolean(kind) or _is_floating(kind))


def _is_floating(kind: pa.DataType) -> bool:
    return bool(pa.types.is_floating(kind))


# What is sent to be done holds until the next message, so its curves are steps.

_COMMAND_TYPES = frozenset(
    (
        *("geometry_msgs.msg.Twist", "geometry_msgs.msg.TwistStamped", "geometry_msgs.msg.Wrench"),
        *("ackermann_msgs.msg.AckermannDrive", "ackermann_msgs.msg.AckermannDriveStamped"),
        *("trajectory_msgs.msg.JointTrajectory", "control_msgs.msg.JointJog"),
    )
)
_COMMAND_NAMES = ("cmd", "command", "setpoint", "target", "goal")


def is_command(topic: str, type_name: str = "") -> bool:
    """Whether messages on a topic are commands, by their type or its name."""
    name = topic.rpartition("/")[2].lower()
    return type_name in _COMMAND_TYPES or any(word in name for word in _COMMAND_NAMES)


# Which topics Rerun's loader may read: it has no limits of its own for what a type says.
#
# A sequence of empty messages is four bytes that ask for gigabytes, a fixed array asks for as many
# values as one likes. rosbags' definition of a type, which our own decoder has checked, tells.

_VALUES_MAX = 1 << 20
"""In the parts of a message whose size is fixed."""


def left_out(trace: Trace) -> dict[str, str]:
    """Return the topics whose messages Rerun must not read, and why not."""
    decoders = Decoders()
    found = {}
    for channel in trace.channels.values():
        try:
            decoder = decoders.of(channel)
            values = _values(decoder.name, decoder.types, {})
        except TraceError as error:
            found[channel.topic] = str(error)
            continue
        except _EmptyItems as error:
            found[channel.topic] = f"{channel.type} has a sequence of {error}, which has no fields"
            continue
        if decoder.wide_texts:
            found[channel.topic] = f"{channel.type} has wide texts (wstring)"
        elif values > _VALUES_MAX:
            found[channel.topic] = f"a {channel.type} has {values} values, more than {_VALUES_MAX}"
    return found


class _EmptyItems(Exception):
    """A sequence whose items have no bytes."""


def _values(name: str, types: dict[str, Any], known: dict[str, int]) -> int:
    """Return how many values a message has at least, the messages in it among them.

    ``types`` do not contain themselves. Raises _EmptyItems.
    """
    if name not in known:
        known[name] = sum(_values_of(field, types, known) for _, field in types[name][1])
    return known[name]


def _values_of(field: Any, types: dict[str, Any], known: dict[str, int]) -> int:
    kind, detail = field
    if kind == Nodetype.BASE:
        return 1
    if kind == Nodetype.NAME:
        return 1 + _values(detail, types, known)
    item, size = detail
    if kind == Nodetype.SEQUENCE:
        if _is_empty(item, types):
            raise _EmptyItems(item[1])
        _values_of(item, types, known)  # within limits, and no sequences of nothing in it
        return 1
    return int(size) * _values_of(item, types, known)


def _is_empty(field: Any, types: dict[str, Any]) -> bool:
    """Whether a field has no bytes: messages of messages of nothing."""
    kind, detail = field
    if kind == Nodetype.ARRAY:
        return _is_empty(detail[0], types)
    return kind == Nodetype.NAME and _has_no_bytes(detail, types, {})


def _has_no_bytes(name: str, types: dict[str, Any], known: dict[str, bool]) -> bool:
    if name not in known:
        known[name] = all(
            (kind == Nodetype.NAME and _has_no_bytes(detail, types, known))
            or (
                kind == Nodetype.ARRAY
                and detail[0][0] == Nodetype.NAME
                and _has_no_bytes(detail[0][1], types, known)
            )
            for _, (kind, detail) in types[name][1]
        )
    return known[name]


_ROWS_PER_CHUNK = 8192
_BYTES_PER_CHUNK = 1 << 20

Stream = tuple[str, tuple[str, ...]]
"""A path and the columns of its rows: such rows follow each other."""

LoadedColumns = tuple[tuple[pa.Field, pa.Array], ...]
"""Columns as the loader made them; the metadata of a field says which component it holds."""


@dataclass(frozen=True, slots=True)
class ComponentRows:
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

    def joined(self, clock: Clock) -> ComponentRows:
        if len(self.parts) == 1:
            arrays = self.parts[0]
        else:
            arrays = [pa.concat_arrays(list(parts)) for parts in zip(*self.parts, strict=True)]
        stamps = np.concatenate(self.stamps_ns)
        events = np.concatenate(self.events)
        times = clock.times(stamps, events)
        columns = tuple(zip(self.fields, arrays, strict=True))
        return ComponentRows(self.topic, self.path, times, stamps, events, columns)


def loaded_columns(batch: pa.RecordBatch) -> LoadedColumns:
    """Return the columns of a loaded chunk that are data, not times or numbers of rows."""
    return tuple(
        (f, batch.column(place))
        for place, f in enumerate(batch.schema)
        if (f.metadata or {}).get(b"rerun:kind") == b"data"
    )
