"""Clocks of nodes that do not show simulated time."""

from __future__ import annotations

from fnmatch import fnmatchcase

from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.chance.stream import ClockModel, RandomStream, SkewedClock
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.trace.model.event import encode_clock_change


@dataclass(frozen=True, slots=True)
class ClockRule:
    """The clock of nodes (a glob). One that ``advances`` shows a nanosecond more at each reading of
    one time. One that ``follows`` takes ROS time from /clock."""

    node: str
    model: ClockModel
    advances: bool = False
    follows: bool = False


class NodeClocks:
    """The clocks of nodes. Each has a random stream for jumps; a jump is an output of the event
    that next reads the clock."""

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
        self._clocks: dict[str, SkewedClock | None] = {}
        self._rule_of: dict[str, ClockRule | None] = {}
        self._ahead: dict[str, tuple[int, int]] = {}
        """For clocks that advance: the time of the last reading, and how far ahead it was."""

    def shows(self, node: str | None, now_ns: int) -> int:
        """Return what the clock of ``node`` shows at simulated time ``now_ns``."""
        if node is None:
            return now_ns
        if node not in self._clocks:
            rule = self._rule(node)
            self._clocks[node] = None
            if rule is not None:
                stream = RandomStream(self._seed, f"clock\0{node}")
                self._clocks[node] = SkewedClock(rule.model, stream, self._start_ns)
        clock = self._clocks[node]
        if clock is None:
            return now_ns
        if self._domain.event.handle is not None and (by_ns := clock.set_since(now_ns)):
            self._note(node, by_ns)
        return clock.shows(now_ns)

    def follows(self, node: str | None) -> bool:
        """Return whether /clock (or user code) sets the ROS time of a node."""
        rule = self._rule(node or "")
        return rule is not None and rule.follows

    def advances(self, node: str | None) -> bool:
        rule = self._rule(node or "")
        return rule is not None and rule.advances

    def look(self, node: str | None, now_ns: int) -> int:
        """Return what a ROS clock of ``node`` shows, and advance it."""
        shown_ns, name = self.shows(node, now_ns), node or ""
        if not self.advances(name):
            return shown_ns
        before_ns, ahead_ns = self._ahead.get(name, (-1, 0))
        if before_ns != now_ns:
            ahead_ns = 0
        else:
            next_ns = self._domain.loop.later_ns()
            if next_ns is None or now_ns + ahead_ns + 1 < next_ns:
                ahead_ns += 1
        self._ahead[name] = now_ns, ahead_ns
        return shown_ns + ahead_ns

    def _rule(self, node: str) -> ClockRule | None:
        """Return the rule of a node's clock; "" is code of no node."""
        if node not in self._rule_of:
            rules = (rule for rule in self._rules if fnmatchcase(node, rule.node))
            self._rule_of[node] = next(rules, None)
        return self._rule_of[node]

    def _note(self, node: str, by_ns: int) -> None:
        for handle in self._domain.graph.nodes_named(node):
            self._domain.dispatcher.draw(handle.entity_id, encode_clock_change(by_ns))
