"""The clocks of nodes that do not show simulated time."""

from __future__ import annotations

from fnmatch import fnmatchcase

from rsltrace.chance.clock import ClockModel, WrongClock
from rsltrace.chance.stream import Stream
from rsltrace.middleware.domain import Domain
from rsltrace.model.draw import encode_clock


class NodeClocks:
    """What each node's clock shows. Each has a stream of its own for random jumps; that one has
    happened is an output of the event in which the clock is read next."""

    def __init__(
        self,
        domain: Domain,
        rules: tuple[tuple[str, ClockModel], ...],
        *,
        seed: int,
        start_ns: int,
    ) -> None:
        self._domain = domain
        self._seed = seed
        self._rules = rules
        self._start_ns = start_ns
        self._clocks: dict[str, WrongClock | None] = {}

    def shows(self, node: str | None, now_ns: int) -> int:
        """Return what the clock of ``node`` (None: nobody's) shows at simulated time ``now_ns``."""
        if node is None:
            return now_ns
        if node not in self._clocks:
            model = next((model for glob, model in self._rules if fnmatchcase(node, glob)), None)
            self._clocks[node] = None
            if model is not None:
                stream = Stream(self._seed, f"clock\0{node}")
                self._clocks[node] = WrongClock(model, stream, self._start_ns)
        clock = self._clocks[node]
        if clock is None:
            return now_ns
        if self._domain.event.handle is not None and (by_ns := clock.set_since(now_ns)):
            self._note(node, by_ns)
        return clock.shows(now_ns)

    def _note(self, node: str, by_ns: int) -> None:
        for handle in self._domain.graph.nodes_named(node):
            self._domain.dispatcher.draw(handle.entity_id, encode_clock(by_ns))
