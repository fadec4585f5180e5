"""The events of a trace on Rerun's timelines: a table, a lane per node, rows per entity, rates."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace.trace.dtypes import OUTPUT_DTYPE
from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.trace.model.texts import NS_PER_S, printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.code import entity_places, places_text
from rsltrace.trace.words.entities import RUN_NAME, flag_names, kind_label
from rsltrace.trace.words.events import group_equal, output_text
from rsltrace_viewer.rerun_export.columns import (
    SIM_TIME,
    Clock,
    Column,
    Times,
    constant,
    lane,
    lane_colours,
    make_chunk,
)
from rsltrace_viewer.rerun_export.moments import Paths

# The texts of events, made for thousands of them at once.
#
# There are few entities and few things an event does, and many events. So every text is made once
# and then taken by number; an event with several outputs is looked up by what they are.

_NAMES_MAX = 6
"""Names of outputs in a text; a constructor makes dozens of entities, which are counted instead."""

_KINDS = 256
"""More than there are kinds of outputs, ever."""

_HEX = np.array([f"{byte:02x}" for byte in range(256)], dtype="S2")


class Labels:
    """Texts for the events of one trace. Columns are Arrow arrays of strings, shape (n,)."""

    def __init__(self, trace: Trace, paths: Paths) -> None:
        self._entities = trace.entities
        self._names = {e.id: paths.name(e) for e in trace.entities.values()}
        count = max(self._names) + 1
        self._known = count
        entities: list[Entity | None] = [trace.entities.get(i) for i in range(count)]
        self._node_texts = pa.array([paths.node_name(e) if e else "?" for e in entities] + ["?"])
        self._callback_texts = pa.array([self._name(i) for i in range(count)] + ["?"])
        self._kind_texts = pa.array([kind_label(EventKind, number) for number in range(256)])
        self._sent: dict[bytes, int] = {b"": 0}
        self._sent_texts: list[str] = [""]
        self._of_single = np.full(count * _KINDS, -1, dtype=np.int64)

    def nodes(self, entities: npt.NDArray[Any]) -> pa.Array:
        return self._node_texts.take(self._numbers(entities))

    def callbacks(self, entities: npt.NDArray[Any]) -> pa.Array:
        return self._callback_texts.take(self._numbers(entities))

    def kinds(self, kinds: npt.NDArray[Any]) -> pa.Array:
        return self._kind_texts.take(pa.array(kinds.astype(np.int32)))

    def sent(self, counts: npt.NDArray[Any], outputs: npt.NDArray[np.void]) -> pa.Array:
        """Return what events did: ``/odom, call /plan``. Their outputs follow each other."""
        what = np.empty((len(outputs), 2), dtype="<u4")
        what[:, 0], what[:, 1] = outputs["entity"], outputs["kind"]
        ends = np.cumsum(counts, dtype=np.int64)
        numbers = np.zeros(len(counts), dtype=np.int64)
        single = counts == 1
        numbers[single] = self._single(what[ends[single] - 1])
        data = what.tobytes()
        several = np.flatnonzero(counts > 1)
        begins = ((ends - counts)[several] * 8).tolist()
        stops = (ends[several] * 8).tolist()
        numbers[several] = [
            self._number(data[begin:stop]) for begin, stop in zip(begins, stops, strict=True)
        ]
        return pa.array(self._sent_texts).take(pa.array(numbers))

    def _single(self, what: npt.NDArray[np.uint32]) -> npt.NDArray[np.int64]:
        """Return the numbers of the texts for single outputs, shape (n,), by a table of them."""
        keys = what[:, 0].astype(np.int64) * _KINDS + np.minimum(what[:, 1], _KINDS - 1)
        if len(keys) and np.max(keys) >= len(self._of_single):
            more = int(np.max(keys)) + 1 - len(self._of_single)
            self._of_single = np.append(self._of_single, np.full(more, -1, dtype=np.int64))
        found = self._of_single[keys]
        while (found < 0).any():
            place = int(np.argmin(found))
            self._of_single[keys[place]] = self._number(what[place].tobytes())
            found = self._of_single[keys]
        return found

    def flags(self, flags: npt.NDArray[Any]) -> pa.Array:
        """Return the names of flags: ``raised``, …; null for none."""
        texts = [" ".join(flag_names(bits)) or None for bits in range(256)]
        return pa.array(texts, type=pa.string()).take(pa.array(flags.astype(np.int32)))

    def _numbers(self, entities: npt.NDArray[Any]) -> pa.Array:
        return pa.array(np.minimum(entities, self._known).astype(np.int32))

    def _number(self, key: bytes) -> int:
        """Return the number of the text for outputs with these entities and kinds."""
        number = self._sent.get(key)
        if number is None:
            number = self._sent[key] = len(self._sent_texts)
            what = np.frombuffer(key, dtype="<u4").reshape(-1, 2).tolist()
            self._sent_texts.append(_listed(self._output(*pair) for pair in what))
        return number

    def _output(self, entity: int, kind: int) -> str:
        found = self._entities.get(entity)
        # New entities are only counted: a constructor makes dozens.
        name = "" if kind == OutputKind.ENTITY else self._name(entity)
        return output_text(kind, name, found.kind.label if found else "entity")

    def _name(self, entity: int) -> str:
        return self._names.get(entity, f"#{entity}") if entity else RUN_NAME


def hashes(values: npt.NDArray[Any]) -> pa.Array:
    """Return 64-bit hashes as 16 hex digits each, as everywhere in rsltrace."""
    digits = _HEX[np.ascontiguousarray(values, dtype=">u8").view(np.uint8)]
    offsets = np.arange(0, 16 * len(values) + 1, 16, dtype=np.int32)
    return pa.StringArray.from_buffers(
        len(values), pa.py_buffer(offsets), pa.py_buffer(digits.tobytes())
    )


def _listed(texts: Iterable[str]) -> str:
    """Return texts in one line: equal ones that follow each other are counted."""
    parts = list(group_equal(texts))
    more = len(parts) - _NAMES_MAX
    return ", ".join(parts[:_NAMES_MAX]) + (f", {more} more" if more > 0 else "")


# How often callbacks run, counted in steps of simulated time.
#
# Counting needs a number per entity and step, whatever the length of the run, so this is gathered
# while the events pass and written at the end.

_STEPS, _STEPS_OF_SHORT = 120, 20
"""About so many points per curve: enough to see a rate change, few enough to be one glance. A step
much shorter than a period would alternate between none and one."""
_SHORT_NS = 10 * NS_PER_S

_SHORTEST_NS = 1_000_000


def step_for(duration_ns: int) -> int:
    """Return a round length (1, 2 or 5 times a power of ten, in ns) of which a run has some 120.

    Runs of up to ten seconds have some 20; longer ones get no step below a second.
    """
    if duration_ns <= _SHORT_NS:
        wanted = max(duration_ns // _STEPS_OF_SHORT, _SHORTEST_NS)
    else:
        wanted = max(duration_ns // _STEPS, NS_PER_S)
    step = _SHORTEST_NS
    while True:
        for factor in (1, 2, 5):
            if step * factor >= wanted:
                return step * factor
        step *= 10


class Rates:
    """Counts events per entity and step of simulated time."""

    def __init__(self, start_ns: int, end_ns: int, entities: int) -> None:
        """Prepare for a run from ``start_ns`` to ``end_ns`` and entity ids below ``entities``."""
        self.step_ns = step_for(max(end_ns - start_ns, 1))
        self._start_ns = start_ns
        self._steps = max(end_ns - start_ns, 0) // self.step_ns + 1
        self._entities = entities
        self._counts = np.zeros((entities, self._steps), dtype=np.int64)
        self._last_event = np.zeros(self._steps, dtype=np.int64)

    def add(self, events: npt.NDArray[np.void]) -> None:
        known = events[events["entity"] < self._entities]
        stamps = known["stamp"].astype(np.int64)
        steps = np.clip((stamps - self._start_ns) // self.step_ns, 0, self._steps - 1)
        cells = known["entity"].astype(np.int64) * self._steps + steps
        size = self._entities * self._steps
        self._counts += np.bincount(cells, minlength=size).reshape(self._counts.shape)
        np.maximum.at(self._last_event, steps, known["index"].astype(np.int64))

    @property
    def stamps_ns(self) -> npt.NDArray[np.int64]:
        """The ends of the steps: a rate is that of the step which ends there. Shape (steps,)."""
        ends = self._start_ns + self.step_ns * np.arange(1, self._steps + 1, dtype=np.int64)
        return np.asarray(ends)

    @property
    def events(self) -> npt.NDArray[np.int64]:
        """The last event of each step, or the one before for a step without any."""
        return np.maximum.accumulate(self._last_event)

    def of(self, entity_ids: list[int]) -> npt.NDArray[np.float64]:
        """Return events per simulated second of some entities together, shape (steps,)."""
        total = self._counts[entity_ids].sum(axis=0)
        return np.asarray(total * (NS_PER_S / self.step_ns), dtype=np.float64)

    def running(self) -> Iterator[int]:
        """Yield the entities that had an event at all."""
        yield from np.flatnonzero(self._counts.any(axis=1)).tolist()


NUMBER = "number"
"""The column of the table that has the number of an event in its run."""

_BATCH_EVENTS = 65_536
_BATCH_OUTPUTS = 262_144
"""A batch ends with either: rows enough to be fast, few enough to be small."""

_NORMAL, _RAISED = "TRACE", "ERROR"
"""Levels of an entity's events among the log records: hidden first, and in the eye."""

Batch = tuple[npt.NDArray[np.void], npt.NDArray[np.void]]


class EventRows:
    """Makes chunks of the events of one trace; memory is that of one batch."""

    def __init__(self, trace: Trace, paths: Paths, clock: Clock) -> None:
        self._trace = trace
        self._paths = paths
        self._clock = clock
        self._labels = Labels(trace, paths)
        entities = trace.entities
        count = max(entities) + 1
        names = sorted({paths.node_name(e) for e in entities.values()})
        self.node_names = names
        self._node_of = np.zeros(count, dtype=np.int64)
        for entity in entities.values():
            self._node_of[entity.id] = names.index(paths.node_name(entity))
        self.rates = Rates(trace.start_ns, trace.end_ns, count)
        self.active_nodes: list[str] = []
        self._active = np.zeros(len(names), dtype=np.bool_)
        self._lane_states: dict[str, dict[str, None]] = {}

    def chunks(self) -> Iterator[Chunk]:
        """Yield all chunks, the rates last. Raises TraceError where the trace is damaged."""
        for events, outputs in self._batches():
            self.rates.add(events)
            times = self._clock.times(events["stamp"], events["index"].astype(np.int64))
            sent = self._labels.sent(events["outputs"].astype(np.int64), outputs)
            callbacks = self._labels.callbacks(events["entity"])
            yield from self._table(events, times, callbacks, sent)
            yield from self._lanes(events, times, callbacks)
            yield from self._entities(events, times, sent)
        self.active_nodes = [n for n, a in zip(self.node_names, self._active, strict=True) if a]
        for path, states in self._lane_states.items():
            yield from lane_colours(path, {text: lane(i) for i, text in enumerate(states)})
        yield from self._rates()
        yield from self._places()

    def _places(self) -> Iterator[Chunk]:
        """Yield where the code of each entity is, beside what it did."""
        for entity in self._trace.entities.values():
            places = printable(places_text(entity_places(self._trace, entity), ", "))
            if places:
                yield from make_chunk(
                    self._paths.callback(entity), (), (("code", pa.array([places])),)
                )

    def _batches(self) -> Iterator[Batch]:
        events: list[npt.NDArray[np.void]] = []
        outputs: list[npt.NDArray[np.void]] = []
        for more_events, more_outputs in zip(
            self._trace.events(), self._trace.outputs(), strict=True
        ):
            events.append(more_events)
            outputs.append(more_outputs)
            if sum(map(len, events)) >= _BATCH_EVENTS or sum(map(len, outputs)) >= _BATCH_OUTPUTS:
                yield np.concatenate(events), np.concatenate(outputs)
                events, outputs = [], []
        if events:
            yield np.concatenate(events), np.concatenate(outputs or [np.zeros(0, OUTPUT_DTYPE)])

    def _table(
        self,
        events: npt.NDArray[np.void],
        times: Times,
        callbacks: pa.Array,
        sent: pa.Array,
    ) -> list[Chunk]:
        causes = events["cause_event"]
        caused = causes != np.uint64(NO_EVENT)
        return make_chunk(
            self._paths.events,
            times,
            (
                *self._numbers(events),
                ("node", self._labels.nodes(events["entity"])),
                ("kind", self._labels.kinds(events["kind"])),
                ("callback", callbacks),
                ("outputs", sent),
                ("cause", pa.array(causes.astype(np.int64), mask=~caused)),
                ("flags", self._labels.flags(events["flags"])),
                ("input_hash", hashes(events["input_hash"])),
                ("output_hash", hashes(events["output_hash"])),
            ),
        )

    def _numbers(self, events: npt.NDArray[np.void]) -> list[Column]:
        """Of two runs, rows are on the timeline: the numbers of events are data."""
        numbers = pa.array(events["index"].astype(np.int64))
        return [] if self._clock.rows is None else [(NUMBER, numbers)]

    def _lanes(
        self, events: npt.NDArray[np.void], times: Times, callbacks: pa.Array
    ) -> Iterator[Chunk]:
        """Yield the lanes. By event, a lane is filled where its node runs, and empty elsewhere; by
        time, where a callback takes none, it shows the last callback that ran."""
        state = rr.StateChange.descriptor_state()
        nodes = self._node_of[np.minimum(events["entity"], len(self._node_of) - 1)]
        (_, stamps), (timeline, rows) = times
        shown = rows.to_numpy()
        following, next_places = np.append(nodes[1:], -1), np.append(shown[1:], -1)
        by_node, numbers, starts = _grouped(nodes)
        for number, own in zip(numbers.tolist(), np.split(by_node, starts[1:]), strict=True):
            self._active[number] = True
            path = self._paths.lane(self.node_names[number])
            texts = callbacks.take(pa.array(own))
            self._lane_states.setdefault(path, {}).update(dict.fromkeys(texts.unique().to_pylist()))
            yield from make_chunk(
                path, ((SIM_TIME, stamps.take(pa.array(own))),), ((state, texts),)
            )
            # Where another node runs next, or nothing in this run, an empty text ends the lane.
            ends = (following[own] != number) | (next_places[own] != shown[own] + 1)
            last = own[ends]
            places = np.concatenate([shown[own], shown[last] + 1])
            order = np.argsort(places, kind="stable")
            with_ends = pa.concat_arrays([texts, constant("", len(last), pa.string())])
            yield from make_chunk(
                path,
                ((timeline, pa.array(places[order])),),
                ((state, with_ends.take(pa.array(order))),),
            )

    def _entities(
        self,
        events: npt.NDArray[np.void],
        times: Times,
        sent: pa.Array,
    ) -> Iterator[Chunk]:
        order, ids, starts = _grouped(events["entity"])
        raised = (events["flags"] & int(EventFlag.RAISED)) != 0
        levels = pa.array([_NORMAL, _RAISED]).take(pa.array(raised.astype(np.int32)))
        for entity_id, own in zip(ids.tolist(), np.split(order, starts[1:]), strict=True):
            entity = self._trace.entities.get(entity_id)
            if entity is None:
                continue
            rows = pa.array(own)
            yield from make_chunk(
                self._paths.callback(entity),
                tuple((name, column.take(rows)) for name, column in times),
                (
                    (rr.TextLog.descriptor_text(), sent.take(rows)),
                    (rr.TextLog.descriptor_level(), levels.take(rows)),
                ),
            )

    def _rates(self) -> Iterator[Chunk]:
        times = self._clock.times(self.rates.stamps_ns, self.rates.events)
        by_node: dict[str, list[int]] = {}
        for entity_id in self.rates.running():
            entity = self._trace.entities.get(entity_id)
            if entity is not None:
                name = self._paths.node_name(entity)
                by_node.setdefault(name, []).append(entity_id)
                path = f"{self._paths.callback(entity)}/rate"
                yield from self._rate(path, times, [entity_id], self._paths.name(entity))
        for name, ids in by_node.items():
            yield from self._rate(f"{self._paths.node(name)}/rate", times, ids, name)

    def _rate(self, path: str, times: Times, ids: list[int], name: str) -> Iterator[Chunk]:
        scalars = pa.array(self.rates.of(ids))
        yield from make_chunk(path, times, ((rr.Scalars.descriptor_scalars(), scalars),))
        label = f"{self._paths.label} {name}".strip()
        yield from make_chunk(
            path, (), ((rr.SeriesLines.descriptor_names(), pa.array([f"{label} [1/s]"])),)
        )


def _grouped(
    keys: npt.NDArray[np.integer[Any]],
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.int64], npt.NDArray[np.intp]]:
    """Return the places of ``keys`` ordered by key, the keys there are, and where each begins.

    The places of a key stay in order. There are rarely more than 65,536 keys, and numpy sorts
    16-bit numbers ten times as fast.
    """
    small = keys.astype(np.uint16) if len(keys) and np.max(keys) < 2**16 else keys
    order = np.argsort(small, kind="stable")
    ids, starts = np.unique(keys[order], return_index=True)
    return order, ids.astype(np.int64), starts
