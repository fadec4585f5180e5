"""The texts of events, made for thousands of them at once.

There are few entities and few things an event does, and many events. So every text is made once
and then taken by number; an event with several outputs is looked up by what they are.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from rsltrace.trace.model.entity import Entity
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.entities import RUN_NAME
from rsltrace.trace.words.kinds import flag_names, kind_label
from rsltrace.trace.words.outputs import counted, output_text
from rsltrace_viewer.rerun_export.paths import Paths

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
        """Return the names of the nodes of entities."""
        return self._node_texts.take(self._numbers(entities))

    def callbacks(self, entities: npt.NDArray[Any]) -> pa.Array:
        """Return the names of entities."""
        return self._callback_texts.take(self._numbers(entities))

    def kinds(self, kinds: npt.NDArray[Any]) -> pa.Array:
        """Return the names of kinds of events."""
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
    parts = list(counted(texts))
    more = len(parts) - _NAMES_MAX
    return ", ".join(parts[:_NAMES_MAX]) + (f", {more} more" if more > 0 else "")
