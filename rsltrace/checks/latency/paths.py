"""Chains of topics: those that are wanted, distinguished by the nodes that publish on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

NO_PATH = -1


class Hop(NamedTuple):
    """A topic, and the node that publishes on it (empty: the run itself, a bag)."""

    node: str
    topic: str


@dataclass(frozen=True, slots=True)
class ChainSelection:
    """Which chains: all that there are, those from and to a topic, or one, by its ``topics``.

    With ``sink``, a node, chains end when a callback of it is done that has taken the last message
    (``sink_hop``). ``via`` are nodes (full names) of which a message that they publish is taken to
    come of the last message that they received of each topic, whatever the trace says of its cause.
    """

    start: str | None = None
    end: str | None = None
    topics: tuple[str, ...] = ()
    via: tuple[str, ...] = ()
    sink: str | None = None

    @property
    def first(self) -> str | None:
        """The topic that chains have to begin with, if there is one."""
        return self.topics[0] if self.topics else self.start

    @property
    def last(self) -> str | None:
        """The topic that chains have to end with, if there is one."""
        return self.topics[-1] if self.topics else self.end


def sink_hop(node: str) -> Hop:
    """Return what stands for the callbacks of a node as the last hop of a chain."""
    return Hop(node, f"({node})")


class ChainPaths:
    """The paths that messages came on, by number. ``hops`` has those of each, as numbers."""

    def __init__(self, wanted: ChainSelection) -> None:
        self.hops: list[tuple[int, ...]] = []
        self.known: list[Hop] = []
        self._wanted = wanted
        self._hops: dict[Hop, int] = {}
        self._numbers: dict[tuple[int, ...], int] = {}
        self._extended: dict[tuple[int, int], int] = {}

    def hop(self, hop: Hop) -> int:
        number = self._hops.setdefault(hop, len(self.known))
        if number == len(self.known):
            self.known.append(hop)
        return number

    def named(self, path: int) -> tuple[Hop, ...]:
        return tuple(self.known[hop] for hop in self.hops[path])

    def begun(self, hop: int) -> int:
        """Return the path that begins, and so far ends, with a hop."""
        return self._number((hop,))

    def begins(self, hop: int) -> bool:
        """Whether every message of a hop begins a path, wherever it came from."""
        return self.known[hop].topic == self._wanted.first

    def prefix(self, path: int, length: int) -> int:
        """Return the path of the first hops of a path, ``NO_PATH`` if no message came on it."""
        return self._numbers.get(self.hops[path][:length], NO_PATH)

    def extended(self, path: int, hop: int) -> int:
        """Return the path that goes on with ``hop``; ``NO_PATH`` if nobody wants it.

        In a loop a path lets go of its beginning: no hop is twice in one, unless the topics of the
        chain are given.
        """
        found = self._extended.get((path, hop))
        if found is None:
            found = self._extended[path, hop] = self._extend(self.hops[path], hop)
        return found

    def ends(self) -> list[int]:
        """Return the paths that are whole: those to the topic that is wanted, or else those that
        nothing came of."""
        wanted = self._wanted
        paths = range(len(self.hops))
        if wanted.topics:
            return [path for path in paths if len(self.hops[path]) == len(wanted.topics)]
        if wanted.end is not None:
            ends = [path for path in paths if self.known[self.hops[path][-1]].topic == wanted.end]
        else:
            gone_on = {self.hops[path][:-1] for path in paths}
            ends = [path for path in paths if self.hops[path] not in gone_on]
        return [path for path in ends if len(self.hops[path]) > 1]

    def _extend(self, hops: tuple[int, ...], hop: int) -> int:
        wanted, topic = self._wanted, self.known[hop].topic
        if wanted.topics:
            fits = len(hops) < len(wanted.topics) and wanted.topics[len(hops)] == topic
            return self._number((*hops, hop)) if fits else NO_PATH
        if wanted.end is not None and self.known[hops[-1]].topic == wanted.end:
            return NO_PATH
        if hop in hops:
            if wanted.start is not None:
                return NO_PATH
            hops = hops[hops.index(hop) + 1 :]
        return self._number((*hops, hop))

    def _number(self, hops: tuple[int, ...]) -> int:
        number = self._numbers.setdefault(hops, len(self.hops))
        if number == len(self.hops):
            self.hops.append(hops)
        return number
