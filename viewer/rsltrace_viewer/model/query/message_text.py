"""Text in messages: their bytes are searched first, and only those that hold it are decoded."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.trace.index import ChannelInfo
from rsltrace.trace.model.event import NO_SEQUENCE, EventKind, OutputKind
from rsltrace.trace.segments import output_of
from rsltrace_viewer.model.query.conditions import Mask
from rsltrace_viewer.model.run import Run, Segment

_SEGMENTS_KEPT = 64
_POSITIONS = np.uint64(1 << 24)
"""More outputs than an event can have: its index times this, plus the position, names one."""
_WITHOUT = frozenset((OutputKind.ENTITY, OutputKind.DRAW))
_RESUME = np.uint8(int(EventKind.RESUME))
_AROUND_VALUES = frozenset("'\"\\{}[]:,()")
_IN_NUMBERS = frozenset("0123456789.+-_ einfatrulso")
"""What numbers, truth values and nothing are written with; their bytes are other ones."""

_Keys = npt.NDArray[np.uint64]


class MessageText:
    """Events whose input or one of whose outputs has ``folded`` in its decoded text."""

    def __init__(self, folded: str) -> None:
        self._folded = folded
        self._keys = lru_cache(maxsize=_SEGMENTS_KEPT)(self._keys_in)
        self._in_all: dict[int, bool] = {}

    def can_be_in(self, run: Run, number: int) -> bool:
        """Return True: only reading the segment tells."""
        return True

    def mask(self, run: Run, segment: Segment, among: Mask) -> Mask:
        """Return the mask."""
        events = segment.events
        own = self._keys(run, segment.number)
        found: Mask = np.isin(events["index"], own // _POSITIONS)
        causes = events["cause_event"]
        caused = among & ~found & (events["kind"] != _RESUME) & (causes < np.uint64(run.count))
        if caused.any():
            firsts = run.segments["first_event"]
            numbers = np.searchsorted(firsts, causes[caused], side="right") - 1
            keys = np.concatenate([self._keys(run, n) for n in np.unique(numbers).tolist()])
            wanted = causes * _POSITIONS + events["cause_output"]
            found |= caused & np.isin(wanted, keys)
        return found

    def _keys_in(self, run: Run, number: int) -> _Keys:
        """Return which outputs in a segment have the text; one that cannot be read has none."""
        outputs = run.segment_outputs(number)
        positions = np.arange(len(outputs)) - np.searchsorted(outputs["event"], outputs["event"])
        keys = outputs["event"] * _POSITIONS + positions.astype(np.uint64)
        kept = (outputs["sequence"] != NO_SEQUENCE) & ~np.isin(outputs["kind"], list(_WITHOUT))
        found: list[int] = []
        for sort in np.unique(outputs[kept][["entity", "kind"]]):
            rows = kept & (outputs["entity"] == sort["entity"]) & (outputs["kind"] == sort["kind"])
            places = np.flatnonzero(rows)
            try:
                one = output_of(outputs[places[0]], run.trace.name)
                channel = run.trace.channel_of(one)
                if channel is None:
                    continue
                if not self._is_in_all(run, channel):
                    places = places[self._held(run, channel, outputs["sequence"][places])]
                    sequences = outputs["sequence"][places].tolist()
                    says = (self._says(run, channel, number) for number in sequences)
                    places = places[np.fromiter(says, np.bool_, len(places))]
            except TraceError:
                continue
            found += places.tolist()
        result: _Keys = keys[sorted(found)]
        return result

    def _held(
        self, run: Run, channel: ChannelInfo, sequences: npt.NDArray[np.uint32]
    ) -> npt.NDArray[np.bool_]:
        """Return which messages of a channel may have the text."""
        if not self._is_in_bytes(channel.schema_text):
            return np.ones(len(sequences), dtype=np.bool_)
        bounds = int(sequences.min()), int(sequences.max())
        text = self._folded.encode()
        hits = np.fromiter(run.trace.holding(channel.id, *bounds, text), np.uint32)
        return np.isin(sequences, hits)

    def _is_in_bytes(self, schema: str) -> bool:
        """Whether bytes tell: no name of a field is meant, no number, and nothing between them."""
        text = self._folded
        return (
            text.isascii()
            and text.isprintable()
            and text == text.strip()
            and not _AROUND_VALUES.intersection(text)
            and not _IN_NUMBERS.issuperset(text)
            and text not in schema.casefold()
            and "wstring" not in schema
        )

    def _is_in_all(self, run: Run, channel: ChannelInfo) -> bool:
        """Whether it is in the name of a field that every message of a channel has."""
        if not self._folded.isidentifier():
            return False
        if channel.id not in self._in_all:
            try:
                _, data = run.trace.message(channel.id, 0)
                names = _names(run.trace.decode(channel, data))
            except TraceError:
                names = iter(())
            self._in_all[channel.id] = any(self._folded in name.casefold() for name in names)
        return self._in_all[channel.id]

    def _says(self, run: Run, channel: ChannelInfo, sequence: int) -> bool:
        from rsltrace.trace.decode import to_plain  # its library takes as long as opening a trace

        try:
            plain = to_plain(run.trace.decode(channel, run.trace.message(channel.id, sequence)[1]))
        except TraceError:  # one that cannot be decoded says nothing of the others
            return False
        return self._folded in str(plain).casefold()


def _names(message: object) -> Iterator[str]:
    """Yield the names of the fields of a decoded message, but for those in its lists."""
    from rsltrace.trace.decode import field_names

    kind: Any = type(message)
    for name in field_names(kind) or ():
        yield name
        yield from _names(getattr(message, name))
