"""What a native run says of its links, its callbacks and its executors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.instances import Durations
from rsltrace.errors import TraceError
from rsltrace.trace.format import METADATA_NATIVE
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind
from rsltrace.trace.native import CUT_AFTER_NS, is_native
from rsltrace.trace.reader import Trace
from rsltrace.trace.timings import event_columns, missing_numbers, senders_of, timings

# Links, callbacks and executors with their times, as a native run had them.


@dataclass(frozen=True, slots=True)
class LinkTimes:
    """A link, or a service where ``is_service``: how long each message was on its way, in ns.

    ``since`` has when each was sent, since the beginning. ``sender`` is the publisher's node, None
    where nobody knows who sent (another process that was not observed). ``waits`` are the times
    from reception to callback, in the same order as ``delays``; a wait before which the clock was
    set is missing from both. ``negative`` counts what was received before it was sent, ``stepped``
    what was on its way while the clock was set, ``history`` what was sent before the subscription
    was there, ``missing`` the numbers between those that came, None where that is unknown.
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
    history: int
    missing: int | None

    def __str__(self) -> str:
        if self.is_service:
            return f"{self.topic} (service)"
        return f"{self.topic}: {self.sender or '(unknown)'} → {self.receiver}"


@dataclass(frozen=True, slots=True)
class CallbackDurations:
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
class ExecutorThreads:
    """Nodes that ran on the same executor, and how many threads of it were seen at work."""

    nodes: tuple[str, ...]
    threads: int


@dataclass(frozen=True, slots=True)
class NativeTimes:
    """All that a native run says.

    ``idle`` are (node, entity) of callbacks that never ran, ``unknown`` counts messages whose
    sender nobody knows, ``tasks`` counts tasks, whose times a job cannot say, ``steps`` how often
    the system clock was set. ``policy`` is that of a simulation that orders callbacks as the
    executors did, None: none does.
    """

    links: tuple[LinkTimes, ...]
    executions: tuple[CallbackDurations, ...]
    executors: tuple[ExecutorThreads, ...]
    idle: tuple[tuple[str, str], ...] = ()
    unknown: int = 0
    tasks: int = 0
    steps: int = 0
    policy: str | None = None


Rows = npt.NDArray[np.void]

STEP_NS = 10_000_000
"""A system clock that moves by more than this against the steady one was set."""
_WINDOW = 5
"""Two clocks are read one after the other, and anything may come in between: medians of so many."""

_TAKES_TIME = (
    EventKind.TIMER,
    EventKind.SUBSCRIPTION,
    EventKind.SERVICE,
    EventKind.CLIENT,
    EventKind.ACTION,
    EventKind.GUARD_CONDITION,
)
_TAKES_NONE = (EventKind.CONSTRUCT, EventKind.RESUME, EventKind.TASK)
"""What runs on executors, too, but has no execution time in a job."""
_EXCHANGES = (int(EventKind.SERVICE), int(EventKind.CLIENT))


def measure_times(trace: Trace) -> NativeTimes:
    """Return what a native run says.

    :raises TraceError: the trace is damaged, simulated, or has no callbacks.
    """
    if not is_native(trace):
        raise TraceError(
            f"{trace.name} is of a simulated run, whose delays and execution times its job says; "
            "observe a real one: rsltrace record --native job.yaml -o native.mcap"
        )
    rows = timings(trace)
    events = event_columns(trace)
    if not len(rows) or not np.isin(events["kind"], _TAKES_TIME).any():
        raise TraceError(f"{trace.name} has no callbacks: there is nothing to measure")
    return _TraceColumns(trace, rows, events).measured()


@dataclass
class _TraceColumns:
    """A native run in columns, each of shape (events,)."""

    trace: Trace
    rows: Rows
    events: Rows
    nodes: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for entity in self.trace.entities.values():
            self.nodes[entity.id] = self.trace.node_of(entity).name if entity.node else ""
        rows = self.rows
        self.steady, self.wall = rows["steady"].astype(np.int64), rows["wall"].astype(np.int64)
        self.source, self.ready = rows["source"].astype(np.int64), rows["ready"].astype(np.int64)
        self.ends = self.steady + rows["duration"].astype(np.int64)
        self.begin_ns = self._begin()
        self.made = self._made()
        self.senders = senders_of(self.trace, self.events)
        last = len(rows) - 1
        self.steps = [
            np.sort(self.wall[[first, min(after, last)]])
            for first, after in clock_steps(self.wall - self.steady)
        ]

    def _begin(self) -> int:
        """Return when the run began as a simulated one does, with timers that are made then: a
        period before the first of them was due (else when all nodes were there), steady."""
        kinds = self.events["kind"]
        for place in np.flatnonzero(kinds == int(EventKind.TIMER))[:1].tolist():
            period = self.trace.entity(int(self.events["entity"][place])).detail.get("period_ns")
            if isinstance(period, int) and self.ready[place]:
                due = self.steady[place] + self.ready[place] - self.wall[place]
                return int(due) - period
        made = self.ends[kinds == int(EventKind.CONSTRUCT)]
        return int(made.max()) if len(made) else int(self.steady[0])

    def _made(self) -> dict[int, int]:
        """Return when the events began that created the entities, by the system clock."""
        parts = [outputs[["kind", "entity"]] for outputs in self.trace.outputs()]
        outputs = np.concatenate(parts)
        rows = np.flatnonzero(outputs["kind"] == int(OutputKind.ENTITY))
        ends = np.cumsum(self.events["outputs"], dtype=np.int64)
        at = self.wall[np.searchsorted(ends, rows, side="right")]
        return dict(zip(outputs["entity"][rows].tolist(), at.tolist(), strict=True))

    def measured(self) -> NativeTimes:
        executor_of, executors = self._executors()
        kinds = self.events["kind"]
        received = np.isin(kinds, (int(EventKind.SUBSCRIPTION), *_EXCHANGES))
        return NativeTimes(
            tuple(self._links()),
            tuple(self._executions(executor_of)),
            executors,
            tuple(self._idle()),
            int((received & (self.source != 0) & (self.senders < 0)).sum()),
            int((kinds == int(EventKind.TASK)).sum()),
            len(self.steps),
            self._policy(),
        )

    def _policy(self) -> str | None:
        native = self.trace.metadata(METADATA_NATIVE)
        single = native.get("executor", "").startswith("SingleThreadedExecutor")
        return native.get("policy") or ("rclpy" if single else None)

    # -- links -----------------------------------------------------------------------------------

    def _links(self) -> Iterator[LinkTimes]:
        kinds, known = self.events["kind"], (self.source != 0) & (self.ready != 0)
        groups: dict[tuple[str, str | None, str, bool], list[int]] = {}
        for place in np.flatnonzero(known).tolist():
            kind, number = int(kinds[place]), int(self.events["entity"][place])
            topic = self.trace.entity(number).name
            if kind in _EXCHANGES:
                groups.setdefault((topic, None, "", True), []).append(place)
            elif kind == EventKind.SUBSCRIPTION:
                sender = int(self.senders[place])
                name = self.nodes.get(sender) if sender >= 0 else None
                groups.setdefault((topic, name, self.nodes[number], False), []).append(place)
        for (topic, sender_name, receiver, is_service), places in sorted(
            groups.items(), key=lambda item: tuple(map(str, item[0]))
        ):
            yield self._link(topic, sender_name, receiver, is_service, np.array(places))

    def _link(
        self,
        topic: str,
        sender: str | None,
        receiver: str,
        is_service: bool,
        places: npt.NDArray[np.intp],
    ) -> LinkTimes:
        source, ready = self.source[places], self.ready[places]
        delays, waits = ready - source, self.wall[places] - ready
        stepped = np.zeros(len(places), dtype=bool)
        for low, high in self.steps:
            stepped |= (source <= high) & (self.wall[places] >= low)
        negative = ~stepped & (delays < 0)
        # What a transient-local publisher kept for a late joiner waited for it, not on the link.
        numbers = self.events["entity"][places].tolist()
        made = np.array([0 if is_service else self.made.get(number, 0) for number in numbers])
        history = ~stepped & (source < made)
        good = ~stepped & ~negative & ~history
        missing = None
        if not is_service and sender is not None:
            numbers, who = self.rows["sequence"][places], self.senders[places]
            missing = missing_numbers(numbers, who)
        return LinkTimes(
            topic,
            sender,
            receiver,
            is_service,
            (self.steady[places] + source - self.wall[places] - self.begin_ns)[good],
            delays[good],
            np.maximum(waits[good], 0),
            int(negative.sum()),
            int(stepped.sum()),
            int(history.sum()),
            missing,
        )

    # -- callbacks -------------------------------------------------------------------------------

    def _executions(self, executor_of: npt.NDArray[np.int64]) -> Iterator[CallbackDurations]:
        kinds = self.events["kind"]
        overhead, tails = self._overhead(executor_of), self._tails()
        groups: dict[tuple[str, str], list[int]] = {}
        for place in np.flatnonzero(np.isin(kinds, _TAKES_TIME)).tolist():
            number = int(self.events["entity"][place])
            entity = self.trace.entity(number)
            if number and entity.kind is not EntityKind.NODE and entity.name:
                groups.setdefault((self.nodes[number], entity.name), []).append(place)
        for (node, name), listed in sorted(groups.items()):
            places = np.array(listed)
            runs = self.rows["duration"][places].astype(np.int64)
            suspended = (self.events["flags"][places] & int(EventFlag.SUSPENDED)) != 0
            cut = suspended & (runs >= CUT_AFTER_NS)
            known = tails[places][tails[places] >= 0]
            yield CallbackDurations(
                node,
                name,
                EventKind(int(kinds[places[0]])).name.lower(),
                self.steady[places] - overhead[places] - self.begin_ns,
                runs,
                runs + overhead[places],
                int((suspended & ~cut).sum()),
                int(cut.sum()),
                int(np.median(known)) if len(known) else 0,
            )

    def _overhead(self, executor_of: npt.NDArray[np.int64]) -> Durations:
        """Return how long each event's executor took for it before it began: since its input was
        there, and since the event before it had ended; 0 where that is unknown."""
        before = np.zeros(len(self.rows), dtype=np.int64)
        ready = self.steady + self.ready - self.wall
        for executor in np.unique(executor_of).tolist():
            mine = np.flatnonzero(executor_of == executor)
            ends = np.sort(self.ends[mine])
            starts = self.steady[mine]
            last = np.searchsorted(ends, starts, side="right") - 1
            free = np.where(last >= 0, ends[np.maximum(last, 0)], np.iinfo(np.int64).min)
            before[mine] = starts - np.maximum(np.minimum(ready[mine], starts), free)
        for low, high in self.steps:
            before[(self.ready <= high) & (self.wall >= low)] = 0
        before[self.ready == 0] = 0
        return before

    def _tails(self) -> Durations:
        """Return for each event the time from the last of its messages that somebody received to
        its end; -1 if nobody did."""
        tails = np.full(len(self.rows), -1, dtype=np.int64)
        causes = self.events["cause_event"]
        known = (self.source != 0) & (causes < np.arange(len(causes)))
        of = causes[known].astype(np.int64)
        left = np.full(len(self.rows), np.iinfo(np.int64).min)
        np.maximum.at(left, of, self.source[known] - self.wall[of])
        sent = left > np.iinfo(np.int64).min
        lasted = self.rows["duration"].astype(np.int64)
        tails[sent] = np.clip(lasted[sent] - left[sent], 0, lasted[sent])
        return tails

    def _executors(self) -> tuple[npt.NDArray[np.int64], tuple[ExecutorThreads, ...]]:
        """Return which executor each event ran on, by number, and the executors with their nodes.

        What shares a thread with something shares its executor; threads of a multi-threaded one
        share its nodes.
        """
        threads = self.rows["thread"].astype(np.int64)
        leader: dict[object, object] = {}

        def find(one: object) -> object:
            while leader.setdefault(one, one) != one:
                one = leader[one]
            return one

        on_executor = np.isin(self.events["kind"], (*_TAKES_TIME, *_TAKES_NONE))
        pairs = np.unique(np.stack((self.events["entity"], threads))[:, on_executor], axis=1).T
        shared = {(self.nodes.get(number, ""), thread) for number, thread in pairs.tolist()}
        for node, thread in sorted(shared):
            if node:
                leader[find(node)] = find(thread)
        places = {thread: find(thread) for thread in np.unique(threads).tolist()}
        numbers = {one: number for number, one in enumerate(dict.fromkeys(places.values()))}
        by_thread = {thread: numbers[one] for thread, one in places.items()}
        at_work = set(threads[np.isin(self.events["kind"], _TAKES_TIME)].tolist())
        found = []
        for number in numbers.values():
            nodes = {node for node, thread in shared if node and by_thread[thread] == number}
            own = {thread for thread in at_work if by_thread[thread] == number}
            if nodes:
                found.append(ExecutorThreads(tuple(sorted(nodes)), max(len(own), 1)))
        return np.array([by_thread[thread] for thread in threads.tolist()]), tuple(found)

    def _idle(self) -> Iterator[tuple[str, str]]:
        ran = set(np.unique(self.events["entity"]).tolist())
        kinds = (EntityKind.TIMER, EntityKind.SUBSCRIPTION)
        for entity in self.trace.entities.values():
            if entity.kind in kinds and entity.id not in ran:
                yield self.nodes[entity.id], entity.name


def clock_steps(offsets: Durations) -> list[tuple[int, int]]:
    """Return between which readings a clock was set, as pairs of their places.

    ``offsets`` is by how much it was ahead of the steady clock, in ns, shape (readings,).
    """
    if len(offsets) < 2 * _WINDOW:
        return []
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(offsets, _WINDOW), axis=1)
    moved = np.abs(smooth[_WINDOW:] - smooth[:-_WINDOW]) > STEP_NS
    begins = np.flatnonzero(moved & ~np.concatenate(([False], moved[:-1])))
    return [(int(place), int(place) + 2 * _WINDOW) for place in begins]
