"""What events sent and got, with values, for rows. Read apart from the rows: messages have to be
decoded for it, and the first of each type takes as long as a screen may."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import replace

from rsltrace.errors import TraceError
from rsltrace.trace.model.event import NO_SEQUENCE, Output, OutputKind
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.model.timeline.events import EventText, outputs_text
from rsltrace_viewer.model.timeline.message_values import message_values

_MESSAGES = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)
_BYTES_MAX = 1 << 16
_OUTPUTS_MAX = 12
_KEPT = 4096


class RowValues:
    """The texts of one run's events that have been read so far."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._texts: OrderedDict[int, str] = OrderedDict()
        self._events: dict[int, EventText] = {}

    def known(self, event: EventText) -> EventText:
        """Return an event with the values of what it did, if these have been read."""
        text = self._texts.get(event.index)
        if not text:
            return event
        found = self._events.get(event.index)
        if found is None:
            found = self._events[event.index] = replace(event, outputs=text)
        return found

    def read(self, indexes: Sequence[int]) -> Iterator[int]:
        """Read events, one at a time; yields how many are done."""
        for count, index in enumerate(indexes, start=1):
            if index not in self._texts:
                self._texts[index] = self._text(index)
                while len(self._texts) > _KEPT:
                    self._events.pop(self._texts.popitem(last=False)[0], None)
            yield count

    def _text(self, index: int) -> str:
        run = self._run
        try:
            event = run.event(index)
            outputs = run.outputs(index)
            if any(output.kind is not OutputKind.DRAW for output in outputs):
                budget = iter(range(_OUTPUTS_MAX))
                return outputs_text(
                    run, outputs, more=lambda o: "" if next(budget, None) is None else self._of(o)
                )
            source = run.input_of(event)
            if source is None or source.kind not in _MESSAGES:
                return ""
            values = self._of(source)
            drawn = outputs_text(run, outputs)
            return ", ".join(filter(None, (values and f"got {values}", drawn)))
        except TraceError:
            return ""  # the row says what is wrong, without values

    def _of(self, output: Output) -> str:
        if output.kind not in _MESSAGES or output.sequence == NO_SEQUENCE:
            return ""
        trace = self._run.trace
        try:
            found = trace.payload(output)
            channel = trace.channel_of(output)
            if found is None or channel is None:
                return ""
            if len(found[2]) > _BYTES_MAX:
                return f"({len(found[2]) / 1e6:.1f} MB)"
            return message_values(trace.decode(channel, found[2]))
        except TraceError:
            return ""
