"""All that observes a process, and a thread that tells the run of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any

from rsltrace.native.apart.gids import gids
from rsltrace.native.apart.link import Link
from rsltrace.native.apart.wire import SpanWriter
from rsltrace.native.boundary import Boundary
from rsltrace.native.executors import Executors
from rsltrace.native.ledger import Ledger
from rsltrace.native.nodes import Nodes
from rsltrace.native.things import Things
from rsltrace.trace.native import CUT_AFTER_NS

_EVERY_S = 0.05
_AT_ONCE = 2_000
"""Spans in one frame, at most."""


class Observers:
    """Observes this process for good, from ``watch`` on."""

    def __init__(self, extension: Any) -> None:
        found = gids(extension)
        self.ledger = Ledger()
        self.things = Things(self.ledger.add)
        self.boundary = Boundary(self.ledger, self.things, None if found is None else found.take)
        self.nodes = Nodes(self.things) if found is None else Nodes(self.things, found.of_publisher)
        self._extension = extension
        self._stack = ExitStack()

    def watch(self) -> None:
        """Begin."""
        executors = Executors(self.ledger, self.things, self.boundary, self.nodes.meet)
        self._stack.enter_context(self.boundary.watched(self._extension))
        self._stack.enter_context(self.nodes.watched())
        self._stack.enter_context(executors.watched(threads_are_processes=False))


class Sender(threading.Thread):
    """Tells the run what was observed, again and again, until ``finish``."""

    def __init__(
        self, link: Link, observers: Observers, is_constructed: Callable[[], bool]
    ) -> None:
        super().__init__(name="rsltrace sender", daemon=True)
        self._link = link
        self._observers = observers
        self._writer = SpanWriter(observers.things)
        self._is_constructed = is_constructed
        self._has_told = False
        self._over = threading.Event()
        self._begun_ns = time.process_time_ns()
        self._own_ns = 0
        """Processor time of this thread."""
        self._lock = threading.Lock()

    def run(self) -> None:
        with suppress(OSError):  # the run is gone, and so is this process in a moment
            while not self._over.wait(_EVERY_S):
                self._tell(CUT_AFTER_NS)
                self._own_ns = time.thread_time_ns()

    def finish(self) -> None:
        """Tell all that is left; callbacks that go on are told of as far as they have come."""
        self._over.set()
        with suppress(OSError):
            self._tell(None)

    def _tell(self, patience_ns: int | None) -> None:
        with self._lock:
            if not self._has_told and self._is_constructed():
                self._has_told = True
                self._link.send("constructed")
            ledger, writer = self._observers.ledger, self._writer
            spans, until_ns = ledger.finished_until(patience_ns)
            definitions = writer.definitions()
            counts = (
                ledger.count,
                ledger.activity_ns,
                self._observers.boundary.unreadable,
                time.process_time_ns() - self._begun_ns,
                self._own_ns,
            )
            parts = [spans[at : at + _AT_ONCE] for at in range(0, len(spans), _AT_ONCE)]
            for number, part in enumerate(parts or [[]]):
                upto_ns = until_ns if number >= len(parts) - 1 else part[-1].start_ns
                told = [writer.plain(span) for span in part]
                self._link.send("spans", upto_ns, counts, definitions if number == 0 else [], told)
