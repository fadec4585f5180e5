"""The clocks of nodes that do not show simulated time."""

from __future__ import annotations

from fnmatch import fnmatchcase

from rsltrace.chance.clock import ClockModel, WrongClock
from rsltrace.chance.stream import Stream


class NodeClocks:
    """What each node's clock shows. Each has a stream of its own for random jumps."""

    def __init__(
        self, rules: tuple[tuple[str, ClockModel], ...], *, seed: int, start_ns: int
    ) -> None:
        self._rules = rules
        self._seed = seed
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
        return now_ns if clock is None else clock.shows(now_ns)
