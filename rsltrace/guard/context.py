"""Which guard is engaged, what it asks of the simulation, and what it keeps for one run: pace and
random streams."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from random import Random
from typing import Any, Protocol

from rsltrace.guard.redirect import copy_of
from rsltrace.trace.model.finding import GuardPolicy

thread_id = copy_of(threading.get_ident)
_engaged: list[Any] = []


def engaged() -> Any:
    """Return the guard engaged in the calling thread (never in a child process), or None."""
    if _engaged:
        guard = _engaged[-1]
        if guard.thread == thread_id():
            return guard
    return None


class engage:  # noqa: N801  (used like a function)
    """Engage ``guard`` in this thread for the block (None: no guard)."""

    __slots__ = ("_before", "_guard")

    def __init__(self, guard: Any) -> None:
        self._guard = guard
        self._before: list[Any] = []

    def __enter__(self) -> None:
        if self._guard is None:
            self._before = _engaged[:]
            _engaged.clear()
        else:
            _engaged.append(self._guard)

    def __exit__(self, *error: object) -> None:
        if self._guard is None:
            _engaged[:] = self._before
        else:
            _engaged.remove(self._guard)


# Simulated time passes as fast as real time while code waits for something outside of the run.

STEP_NS = 1_000_000
_IN_A_ROW_MAX = 20
_LAG_NS_MAX = 100_000_000
"""A slow run catches up, but minutes of computing do not count as minutes of waiting."""

_real_ns = copy_of(time.monotonic_ns)


class RealTimePace:
    """How far simulated time is ahead of real time since code began to wait."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self.in_a_row = 0
        """How many waits in a row ended at once, because the answer was there already."""

    def is_greedy(self) -> bool:
        """Count one more answer that was there at once; return whether others should run now."""
        self.in_a_row += 1
        if self.in_a_row < _IN_A_ROW_MAX:
            return False
        self.in_a_row = 0
        return True

    def ahead_s(self, now_ns: int) -> float:
        """Return how many real seconds to wait before simulated time may go on."""
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


# Each node draws from its own random generators, so adding a node does not change the others.


class RandomStreams:
    """The random generators of one run, by node; made when first used from the job's seed."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
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
        """Return the generator behind ``random``'s functions for a node."""
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
        """Return the generator behind ``numpy.random``'s functions for a node."""
        found = self._numpy.get(name)
        if found is None:
            import numpy as np

            seed = Random(f"numpy {self._seed_of(name)} {name}").getrandbits(32)
            found = self._numpy[name] = np.random.RandomState(seed)
        return found


class SimulationContext(Protocol):
    """What a guard asks of the simulation."""

    direct: tuple[Any, Any] | None
    """The objects that hold simulated time and the index of the current event (``now_ns``,
    ``events``) and the running node (``node``, with ``key``); None where a node's clocks differ.
    Reading them is much cheaper than ``look`` and ``node``."""

    def now_ns(self) -> int:
        """Return simulated time."""

    def look(self) -> tuple[int, str, int]:
        """Return the index of the current event, the node and simulated time."""

    def node(self) -> str:
        """Return the node whose code runs, or an empty text."""

    def process(self) -> int:
        """Return the number of the running process: 0 for nodes that the job constructs, then the
        mains from 1, in the order of the job."""

    def policy(self) -> GuardPolicy | None:
        """Return the policy of that node, or None for the job's."""

    def place(self) -> tuple[int, int]:
        """Return the index of the current event and the entity that runs."""

    def pass_time(self, for_ns: int) -> None:
        """Let simulated time pass, if the running code can wait."""

    def is_aside(self) -> bool:
        """Return whether others can run while the running code waits for something outside."""

    def can_step(self) -> bool:
        """Return whether the running code can wait in simulated time at all."""

    def step(self, for_ns: int) -> None:
        """Let simulated time pass while the running code waits for something outside."""
