"""When the entries of a native run begin that do not begin with it (``start_after:``)."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from rsltrace.adapters.rclpy.entry import StartRule
from rsltrace.native.span_recorder import CallbackSpan, SentMessage, now_ns
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import OutputKind

if TYPE_CHECKING:
    from rsltrace.native.processes.children import ObservedProcess

StartFact = tuple[str, str]
"""What has come true: ``topic``, ``service``, ``node``, ``started`` or ``ended``, and its name."""

_MADE = {EntityKind.NODE: "node", EntityKind.SERVICE: "service"}


class StartQueue:
    """Takes facts from threads, and says which entries begin."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._facts: set[StartFact] = set()
        self._waiting: list[tuple[ObservedProcess, StartRule, int]] = []
        self._since_ns: dict[int, int] = {}

    @property
    def waiting(self) -> list[ObservedProcess]:
        """The processes that have not begun."""
        return [child for child, _, _ in self._waiting]

    def add(self, child: ObservedProcess, rule: StartRule) -> None:
        """Let a process begin once its rule is met."""
        self._waiting.append((child, rule, now_ns()))

    def tell(self, what: str, name: str) -> None:
        """Say what has come true."""
        with self._lock:
            self._facts.add((what, name))

    def look_at(self, spans: Iterable[CallbackSpan]) -> None:
        """Find in what was observed what has come true."""
        found: set[StartFact] = set()
        for span in spans:
            for output in span.outputs:
                if isinstance(output, SentMessage) and output.kind == OutputKind.MESSAGE:
                    found.add(("topic", output.entity.name))
                elif isinstance(output, Entity) and output.kind in _MADE:
                    found.add((_MADE[output.kind], output.name))
        with self._lock:
            self._facts |= found

    def due(self) -> Iterator[ObservedProcess]:
        """Yield the processes that are to begin now."""
        now, left = now_ns(), []
        for waiting in self._waiting:
            child, rule, since_ns = waiting
            if self.unmet(rule):
                left.append((child, rule, now))
            elif now - since_ns >= rule.delay_ns:
                yield child
            else:
                left.append(waiting)
        self._waiting = left

    def unmet(self, rule: StartRule) -> list[str]:
        """Return what of a rule has not come true."""
        wanted = [
            (what, getattr(rule, what)) for what in ("topic", "service", "node", "started", "ended")
        ]
        with self._lock:
            return [what for what, name in wanted if name and (what, name) not in self._facts]

    def missed(self) -> list[tuple[str, list[str]]]:
        """Return the keys of the entries that have not begun, and what they waited for."""
        return [(child.what.key, self.unmet(rule)) for child, rule, _ in self._waiting]
