"""The events of a trace on Rerun's timelines: a table, a lane per node, rows per entity, rates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from rsltrace.trace.format import OUTPUT_DTYPE
from rsltrace.trace.model.event import NO_EVENT, EventFlag
from rsltrace.trace.model.printable import printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.code import entity_places, places_text
from rsltrace_viewer.rerun_export.colours import lane
from rsltrace_viewer.rerun_export.columns import (
    EVENT,
    SIM_TIME,
    Clock,
    constant,
    lane_colours,
    make_chunk,
)
from rsltrace_viewer.rerun_export.events.labels import Labels, hashes
from rsltrace_viewer.rerun_export.events.rates import Rates
from rsltrace_viewer.rerun_export.paths import Paths

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
            stamps = self._clock.array(events["stamp"])
            indexes = pa.array(events["index"].astype(np.int64))
            sent = self._labels.sent(events["outputs"].astype(np.int64), outputs)
            callbacks = self._labels.callbacks(events["entity"])
            yield from self._table(events, stamps, indexes, callbacks, sent)
            yield from self._lanes(events, stamps, callbacks)
            yield from self._entities(events, stamps, indexes, sent)
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
        """Join segments until they are a batch."""
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
        stamps: pa.Array,
        indexes: pa.Array,
        callbacks: pa.Array,
        sent: pa.Array,
    ) -> list[Chunk]:
        causes = events["cause_event"]
        caused = causes != np.uint64(NO_EVENT)
        return make_chunk(
            self._paths.events,
            ((SIM_TIME, stamps), (EVENT, indexes)),
            (
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

    def _lanes(
        self, events: npt.NDArray[np.void], stamps: pa.Array, callbacks: pa.Array
    ) -> Iterator[Chunk]:
        """Yield the lanes. By event, a lane is filled where its node runs, and empty elsewhere; by
        time, where a callback takes none, it shows the last callback that ran."""
        state = rr.StateChange.descriptor_state()
        nodes = self._node_of[np.minimum(events["entity"], len(self._node_of) - 1)]
        indexes = events["index"].astype(np.int64)
        following = np.append(nodes[1:], -1)
        by_node, numbers, starts = _grouped(nodes)
        for number, own in zip(numbers.tolist(), np.split(by_node, starts[1:]), strict=True):
            self._active[number] = True
            path = self._paths.node(self.node_names[number])
            texts = callbacks.take(pa.array(own))
            self._lane_states.setdefault(path, {}).update(dict.fromkeys(texts.unique().to_pylist()))
            yield from make_chunk(
                path, ((SIM_TIME, stamps.take(pa.array(own))),), ((state, texts),)
            )
            # Where another node runs next, an empty text ends the lane.
            last = own[following[own] != number]
            places = np.concatenate([indexes[own], indexes[last] + 1])
            order = np.argsort(places, kind="stable")
            with_ends = pa.concat_arrays([texts, constant("", len(last), pa.string())])
            yield from make_chunk(
                path,
                ((EVENT, pa.array(places[order])),),
                ((state, with_ends.take(pa.array(order))),),
            )

    def _entities(
        self,
        events: npt.NDArray[np.void],
        stamps: pa.Array,
        indexes: pa.Array,
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
                ((SIM_TIME, stamps.take(rows)), (EVENT, indexes.take(rows))),
                (
                    (rr.TextLog.descriptor_text(), sent.take(rows)),
                    (rr.TextLog.descriptor_level(), levels.take(rows)),
                ),
            )

    def _rates(self) -> Iterator[Chunk]:
        times = (
            (SIM_TIME, self._clock.array(self.rates.stamps_ns)),
            (EVENT, pa.array(self.rates.events)),
        )
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

    def _rate(
        self, path: str, times: tuple[tuple[str, pa.Array], ...], ids: list[int], name: str
    ) -> Iterator[Chunk]:
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
