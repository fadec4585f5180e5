"""What is analyzed: callbacks as parts of chains, on executors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

# How often work can arrive within a time, and how much processor time a supply gives at least.
# Times are whole nanoseconds (any unit will do); intervals are half-open, so that what arrives
# within a closed interval of length t is ``arrivals(t + 1)``.


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Arrivals every ``period_ns``, each up to ``jitter_ns`` late, never closer than
    ``distance_ns``."""

    period_ns: int
    jitter_ns: int = 0
    distance_ns: int = 0

    def within(self, length_ns: int) -> int:
        """Return the most arrivals in any interval of that length."""
        if length_ns <= 0:
            return 0
        count = -(-(length_ns + self.jitter_ns) // self.period_ns)
        if self.distance_ns > 0:
            count = min(count, -(-length_ns // self.distance_ns))
        return count

    def delayed(self, by_ns: int) -> Arrivals:
        """Return the arrivals of what comes of these up to ``by_ns`` later, or at once."""
        return Arrivals(self.period_ns, self.jitter_ns + by_ns)

    def earliest(self, end_ns: int) -> Iterator[tuple[int, int]]:
        """Yield (offset, number) of arrivals that all come as early as they can, up to ``end_ns``;
        of those at one offset the last."""
        offset_ns = 0
        while offset_ns < end_ns:
            count = self.within(offset_ns + 1)
            yield offset_ns, count
            after_ns = count * self.period_ns - self.jitter_ns
            offset_ns = max(after_ns, count * self.distance_ns, offset_ns + 1)


@dataclass(frozen=True, slots=True)
class Supply:
    """A reservation: ``budget_ns`` of processor time in each ``period_ns``; equal ones mean a
    processor of its own."""

    budget_ns: int = 1
    period_ns: int = 1

    def time_for(self, work_ns: int) -> int:
        """Return the longest that it may take until so much work is done (Casini et al. 2019,
        section 2: the inverse of the supply-bound function of a periodic reservation)."""
        if work_ns <= 0 or self.budget_ns >= self.period_ns:
            return max(work_ns, 0)
        gap_ns = self.period_ns - self.budget_ns
        rounds, rest_ns = divmod(work_ns, self.budget_ns)
        return gap_ns + rounds * self.period_ns + (gap_ns + rest_ns if rest_ns else 0)


PROCESSOR = Supply()
"""A processor of its own."""


ONCE_NS = 1 << 61
"""The period of what came once."""


class ExecutorOrder(Enum):
    """What is known of the order in which an executor runs what is ready."""

    ANY = "any order"
    """It is never idle while something is ready, and finishes what it has begun."""
    PRIORITY = "priorities"
    """The most urgent first (``CallbackKey.urgency``, the lower the more)."""
    WAIT_SET = "wait set"
    """Timers first, then what polling points have found."""
    POLLED = "wait set with polled timers"
    """What polling points have found, timers as well."""


@dataclass(frozen=True, slots=True)
class ExecutorModel:
    """An executor with one thread. ``above`` are those that interrupt it whenever they have
    something to do: of the same processor, with real-time priorities that are not lower."""

    order: ExecutorOrder = ExecutorOrder.ANY
    supply: Supply = PROCESSOR
    above: frozenset[str] = frozenset()


class CallbackKey(NamedTuple):
    """A callback: its node and entity, which of those of that name it is; its kind."""

    node: str
    kind: str
    name: str
    ordinal: int = 0

    def __str__(self) -> str:
        return f"{self.node} {self.name}"


@dataclass(frozen=True, slots=True)
class ChainTask:
    """A callback as a part of a chain (a tree of them: what comes of a task are its children).

    ``executor`` is None where it is on one that is not analyzed. ``arrivals`` are those of a task
    that nothing has caused; of others ``parent`` is the index of the task that they come of,
    ``link_ns`` the longest that messages take (None: no bound), and ``count`` how many come
    of one run. ``place`` says which of those that a polling point has found runs first.
    """

    callback: CallbackKey
    executor: str | None
    wcet_ns: int
    arrivals: Arrivals | None = None
    parent: int | None = None
    link_ns: int | None = 0
    count: int = 1
    urgency: float = 0.0
    place: tuple[int, ...] = ()

    @property
    def is_timer(self) -> bool:
        """Whether it is a timer's callback."""
        return self.callback.kind == "timer"


@dataclass(frozen=True, slots=True)
class TaskSystem:
    """Tasks, parents before children, and executors by name.

    ``varying`` are callbacks whose urgency is not always the same.
    """

    tasks: tuple[ChainTask, ...]
    executors: dict[str, ExecutorModel] = field(default_factory=dict)
    varying: frozenset[CallbackKey] = frozenset()

    def executor_of(self, task: ChainTask) -> ExecutorModel | None:
        """Return the executor of a task, None if it is not analyzed."""
        return None if task.executor is None else self.executors.get(task.executor, ExecutorModel())

    def arrivals(self, task: ChainTask) -> Arrivals:
        """Return how often the chain of a task is released."""
        if task.parent is not None:
            return self.arrivals(self.tasks[task.parent])
        assert task.arrivals is not None, "what has no parent has arrivals"
        return task.arrivals

    def count(self, task: ChainTask) -> int:
        """Return how many of a task come of one release of its chain, at most."""
        return task.count * (1 if task.parent is None else self.count(self.tasks[task.parent]))
