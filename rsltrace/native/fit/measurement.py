"""Links, callbacks and executors with their times, as a native run had them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsltrace.checks.latency.figures import Durations


@dataclass(frozen=True, slots=True)
class Link:
    """A link, or a service where ``is_service``: how long each message was on its way, in ns.

    ``since`` has when each was sent, since the beginning. ``sender`` is the publisher's node, None
    where nobody knows who sent (another process that was not observed). ``waits`` are the times
    from reception to callback, in the same order as ``delays``; a wait before which the clock was
    set is missing from both. ``negative`` counts what was received before it was sent, ``stepped``
    what was on its way while the clock was set, ``missing`` the numbers between those that came,
    None where that is unknown.
    """

    topic: str
    sender: str | None
    receiver: str
    is_service: bool
    since: Durations
    delays: Durations
    waits: Durations
    negative: int
    stepped: int
    missing: int | None

    def __str__(self) -> str:
        if self.is_service:
            return f"{self.topic} (service)"
        return f"{self.topic}: {self.sender or '(unknown)'} → {self.receiver}"


@dataclass(frozen=True, slots=True)
class Execution:
    """A callback: how long it kept its executor, each time, in ns, shape (runs,).

    ``since`` has when its executor began with each, since the beginning. ``runs`` are the times of
    the callback itself; ``busy`` has what the executor needed before it
    on top: from the moment when the input was there and the executor was free. ``parts`` counts
    those that were suspended, of which only the first part is known to the simulation, ``cut``
    those that went on for so long that the trace has them in parts. ``tail_ns`` is the median time
    from the last message that is known to have left, to the end.
    """

    node: str
    entity: str
    kind: str
    since: Durations
    runs: Durations
    busy: Durations
    parts: int
    cut: int
    tail_ns: int

    @property
    def tied(self) -> float:
        """The correlation of each of ``busy`` with the one before; 0 where there is none."""
        before, after = self.busy[:-1].astype(np.float64), self.busy[1:].astype(np.float64)
        if len(before) < 2 or not before.std() or not after.std():
            return 0.0
        return float(np.corrcoef(before, after)[0, 1])


@dataclass(frozen=True, slots=True)
class Executor:
    """Nodes that ran on the same executor, and how many threads of it were seen at work."""

    nodes: tuple[str, ...]
    threads: int


@dataclass(frozen=True, slots=True)
class Measured:
    """All that a native run says.

    ``idle`` are (node, entity) of callbacks that never ran, ``unknown`` counts messages whose
    sender nobody knows, ``tasks`` counts tasks, whose times a job cannot say, ``steps`` how often
    the system clock was set. ``policy`` is that of a simulation that orders callbacks as the
    executors did, None: none does.
    """

    links: tuple[Link, ...]
    executions: tuple[Execution, ...]
    executors: tuple[Executor, ...]
    idle: tuple[tuple[str, str], ...] = ()
    unknown: int = 0
    tasks: int = 0
    steps: int = 0
    policy: str | None = None
