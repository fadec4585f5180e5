"""What several processes have done, in the order in which it began.

All have one steady clock. A process says up to when it has told everything; what began before that
in all of them is in order for good.
"""

from __future__ import annotations

import threading
from collections import deque

from rsltrace.native.ledger import Span, now_ns
from rsltrace.trace.model.stamp import NS_PER_S

STALLED_NS = 20 * NS_PER_S
"""A process that says nothing for so long (stopped, or in a call that keeps the interpreter) must
not keep all others from the file."""


class Source:
    """One process: the spans that it has told of, and up to when that is all of them."""

    def __init__(self) -> None:
        self.spans: deque[Span] = deque()
        self.until_ns = now_ns()
        self.is_over = False


class Merge:
    """Takes spans from threads, and gives them in the order of their starts."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sources: list[Source] = []
        self._latest_ns = 0
        self.late = 0
        """Spans that came too late for their place, and were put after what was written."""

    def source(self) -> Source:
        """Return a new source: nothing is in order from now on before it has said so."""
        with self._lock:
            source = Source()
            self._sources.append(source)
            return source

    def add(self, source: Source, spans: list[Span], until_ns: int) -> None:
        """Add spans in the order of their starts; no other one will begin before ``until_ns``."""
        with self._lock:
            source.spans.extend(spans)
            source.until_ns = max(source.until_ns, until_ns)

    def end(self, source: Source) -> None:
        """Take note that nothing more comes from a source."""
        with self._lock:
            source.is_over = True

    def finished(self, patience_ns: int | None) -> list[Span]:
        """Take what is in order, everything if ``patience_ns`` is None."""
        with self._lock:
            taken = self._taken(self._until(patience_ns))
        for span in taken:
            if span.start_ns < self._latest_ns:
                self.late += 1
                span.start_ns = self._latest_ns
                span.end_ns = max(span.end_ns, span.start_ns)
            self._latest_ns = span.start_ns
        return taken

    def _until(self, patience_ns: int | None) -> int | None:
        if patience_ns is None:
            return None
        patient_ns = now_ns() - STALLED_NS
        waited = [
            source.until_ns
            for source in self._sources
            if not source.is_over and source.until_ns > patient_ns
        ]
        return min(waited, default=None)

    def _taken(self, until_ns: int | None) -> list[Span]:
        taken: list[Span] = []
        for source in self._sources:
            spans = source.spans
            while spans and (until_ns is None or spans[0].start_ns < until_ns):
                taken.append(spans.popleft())
        self._sources = [one for one in self._sources if one.spans or not one.is_over]
        taken.sort(key=lambda span: span.start_ns)
        return taken
