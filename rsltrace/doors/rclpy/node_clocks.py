"""The clocks of nodes that do not show simulated time."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase

from rsltrace.chance.clock import ClockModel, WrongClock
from rsltrace.chance.stream import Stream
from rsltrace.middleware.domain import Domain
from rsltrace.model.draw import encode_clock


@dataclass(frozen=True, slots=True)
class ClockRule:
    """What is different about the clocks of nodes (a glob). One that ``advances`` shows a
    nanosecond more at each look at one time."""

    node: str
    model: ClockModel
    advances: bool = False


class NodeClocks:
    """What each node's clock shows. Each has a stream of its own for random jumps; that one has
    happened is an output of the event in which the clock is read next."""

    def __init__(
        self,
        domain: Domain,
        rules: tuple[ClockRule, ...],
        *,
        seed: int,
        start_ns: int,
    ) -> None:
        self._domain = domain
        self._seed = seed
        self._rules = rules
        self._start_ns = start_ns
        self._clocks: dict[str, WrongClock | None] = {}
        self._advancing: set[str] = set()
        self._ahead: dict[str, tuple[int, int]] = {}
        """Of a clock that advances: the time of the last look, and how far ahead it was."""

    def shows(self, node: str | None, now_ns: int) -> int:
        """Return what the clock of ``node`` (None: nobody's) shows at simulated time ``now_ns``."""
        if node is None:
            return now_ns
        if node not in self._clocks:
            rule = next((rule for rule in self._rules if fnmatchcase(node, rule.node)), None)
            self._clocks[node] = None
            if rule is not None:
                stream = Stream(self._seed, f"clock\0{node}")
                self._clocks[node] = WrongClock(rule.model, stream, self._start_ns)
                if rule.advances:
                    self._advancing.add(node)
        clock = self._clocks[node]
        if clock is None:
            return now_ns
        if self._domain.event.handle is not None and (by_ns := clock.set_since(now_ns)):
            self._note(node, by_ns)
        return clock.shows(now_ns)

    def look(self, node: str | None, now_ns: int) -> int:
        """Return what a ROS clock of ``node`` shows to who looks at it now."""
        shown_ns = self.shows(node, now_ns)
        if node is None or node not in self._advancing:
            return shown_ns
        before_ns, ahead_ns = self._ahead.get(node, (-1, 0))
        if before_ns != now_ns:
            ahead_ns = 0
        else:
            next_ns = self._domain.loop.later_ns()
            if next_ns is None or now_ns + ahead_ns + 1 < next_ns:
                ahead_ns += 1
        self._ahead[node] = now_ns, ahead_ns
        return shown_ns + ahead_ns

    def _note(self, node: str, by_ns: int) -> None:
        for handle in self._domain.graph.nodes_named(node):
            self._domain.dispatcher.draw(handle.entity_id, encode_clock(by_ns))
