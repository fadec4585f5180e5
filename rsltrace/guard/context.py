"""What the guard asks of the simulation, whose code it does not know."""

from __future__ import annotations

import time
from collections.abc import Callable
from random import Random
from typing import Any, Protocol

from rsltrace.guard.redirect import copy_of
from rsltrace.trace.model.finding import Policy

# How fast simulated time passes while somebody waits for what is outside: as fast as real time.

STEP_NS = 1_000_000
_IN_A_ROW_MAX = 20
_LAG_NS_MAX = 100_000_000
"""A run that is slow catches up; but one that computed for minutes has not waited for minutes."""

_real_ns = copy_of(time.monotonic_ns)  # type: ignore[arg-type]


class RealTimePace:
    """Tells how far simulated time has got ahead of real time since somebody began to wait."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self.in_a_row = 0
        """How many waits in a row ended at once, because the answer was there already."""

    def is_greedy(self) -> bool:
        """Count one more such answer; return whether it is time to let others go on."""
        self.in_a_row += 1
        if self.in_a_row < _IN_A_ROW_MAX:
            return False
        self.in_a_row = 0
        return True

    def ahead_s(self, now_ns: int) -> float:
        """Return how many seconds to wait for real before simulated time may go on."""
        real_ns: int = _real_ns()
        if self._offset_ns is None:
            self._offset_ns = now_ns - real_ns
        ahead_ns = now_ns - real_ns - self._offset_ns
        if ahead_ns > STEP_NS:  # others have made time pass meanwhile
            ahead_ns = STEP_NS
        elif ahead_ns < -_LAG_NS_MAX:
            ahead_ns = -_LAG_NS_MAX
        self._offset_ns = now_ns - real_ns - ahead_ns
        return max(ahead_ns, 0) / 1e9


# Random generators by name: each node draws from its own, so one more node changes nothing.


class RandomStreams:
    """The generators of one run, by name: made when first used, seeded by the job's seed."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        """The job's."""
        self._random: dict[str, Random] = {}
        self._entropy: dict[str, Random] = {}
        self._numpy: dict[str, Any] = {}
        self.last_uuid: dict[str, int | None] = {}
        self.file_names: dict[str, Any] = {}
        self._begun: dict[str, str] = {}

    def begin(self, name: str, entropy: Callable[[], str]) -> None:
        """Let a node's streams begin with entropy from outside, the first time it draws."""
        if name not in self._begun:
            self._begun[name] = ""  # in case asking for it draws
            self._begun[name] = entropy()

    def _seed_of(self, name: str) -> str:
        entropy = self._begun.get(name)
        return f"{self.seed} {entropy}" if entropy else str(self.seed)

    def random(self, name: str) -> Random:
        """Return the stand-in for the generator behind ``random``'s functions."""
        found = self._random.get(name)
        if found is None:
            found = self._random[name] = Random(f"random {self._seed_of(name)} {name}")
        return found

    def entropy(self, name: str, size: int) -> bytes:
        """Return the next bytes in place of the operating system's."""
        found = self._entropy.get(name)
        if found is None:
            found = self._entropy[name] = Random(f"entropy {self._seed_of(name)} {name}")
        return found.randbytes(size)

    def numpy(self, name: str) -> Any:
        """Return the stand-in for the generator behind ``numpy.random``'s functions."""
        found = self._numpy.get(name)
        if found is None:
            import numpy as np

            seed = Random(f"numpy {self._seed_of(name)} {name}").getrandbits(32)
            found = self._numpy[name] = np.random.RandomState(seed)
        return found


class Context(Protocol):
    """What a guard asks of the simulation."""

    direct: tuple[Any, Any] | None
    """Where all clocks show simulated time: what has that (``now_ns``) and the index of the event
    under way (``events``), and what has the node whose code runs (``node``, if any, and its
    ``key``). Looking there oneself takes a fraction of asking ``look`` or ``node``."""

    def now_ns(self) -> int:
        """Return simulated time."""

    def look(self) -> tuple[int, str, int]:
        """Return the index of the event under way, the node and simulated time."""

    def node(self) -> str:
        """Return the node whose code runs, or an empty text."""

    def process(self) -> int:
        """Return which of the run's processes that is: 0 has the nodes that the job constructs,
        the mains count from 1 in the order of the job."""

    def policy(self) -> Policy | None:
        """Return the policy of that node, or None for the job's."""

    def place(self) -> tuple[int, int]:
        """Return the index of the event under way and the entity that runs."""

    def pass_time(self, for_ns: int) -> None:
        """Let simulated time pass, if whoever runs can wait."""

    def is_aside(self) -> bool:
        """Return whether others can go on while whoever runs waits for what is outside."""

    def can_step(self) -> bool:
        """Return whether whoever runs can wait in simulated time at all."""

    def step(self, for_ns: int) -> None:
        """Let simulated time pass while whoever runs waits for what is outside."""
