"""The loop of jobs with a policy, simulated executors or execution times.

It keeps the rules of ``loop.py`` except for the order: due timers are candidates beside what is
ready, a policy chooses, and callbacks wait while all workers of their executor are busy. It is a
separate loop so that the plain one does not pay for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from heapq import heappop
from typing import Any

from rsltrace.errors import RunError
from rsltrace.fast_dataclass import dataclass
from rsltrace.simulation.loop.loop import Dispatchable, EventLoop
from rsltrace.simulation.loop.policy import (
    Candidate,
    ChoicePoint,
    ExecutionPolicy,
    Fifo,
    PolicyChoices,
)
from rsltrace.simulation.loop.timer_queue import TimerState


@dataclass(eq=False)
class SimulatedExecutor:
    """A simulated executor: how many callbacks it can run at once, and how many are running."""

    name: str
    count: int = 1
    running: int = 0

    @property
    def are_busy(self) -> bool:
        return self.running >= self.count


@dataclass(frozen=True, slots=True)
class ReadyItem:
    """Something that may run, as the loop sees it.

    ``workers`` is None for what runs on no simulated executor. ``exclusive`` is the mutually
    exclusive callback group, or None. ``handed_over``: dispatching only hands it to one of the
    user's own executors.
    """

    candidate: Candidate
    workers: SimulatedExecutor | None
    exclusive: object | None
    handed_over: bool = False


@dataclass(eq=False, slots=True)
class ExecutionCharge:
    """The execution time of the current callback; the middleware adds to it."""

    duration_ns: int = 0


class _ReadyQueue:
    """The ordered loop's queue of what is ready, in order of arrival."""

    def __init__(
        self, place: Callable[[Dispatchable], ReadyItem], runs: Callable[[ReadyItem], bool]
    ):
        self.places: list[ReadyItem] = []
        self._place = place
        self._runs = runs

    def append(self, item: Dispatchable) -> None:
        self.places.append(self._place(item))

    def appendleft(self, item: Dispatchable) -> None:
        self.insert(0, item)

    def insert(self, index: int, item: Dispatchable) -> None:
        self.places.insert(index, self._place(item))

    def extend(self, items: Iterable[Dispatchable]) -> None:
        for item in items:
            self.append(item)

    def popleft(self) -> Dispatchable:
        item: Dispatchable = self.places.pop(0).candidate.item
        return item

    def pop(self) -> Dispatchable:
        item: Dispatchable = self.places.pop().candidate.item
        return item

    def __getitem__(self, index: int) -> Dispatchable:
        item: Dispatchable = self.places[index].candidate.item
        return item

    def runnable(self) -> Iterator[ReadyItem]:
        return filter(self._runs, self.places)

    def __bool__(self) -> bool:
        return any(True for _ in self.runnable())

    def __len__(self) -> int:
        return len(self.places)


class OrderedLoop(EventLoop):
    """An event loop with a policy. The middleware sets ``place``, which describes an item."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.policy: ExecutionPolicy = Fifo()
        self.place: Callable[[Dispatchable], ReadyItem]
        self.charge = ExecutionCharge()
        self.choices: PolicyChoices | None = None
        """The policy's choices so far, if they are recorded."""
        self.on_choice: Callable[[Sequence[Candidate], int, ChoicePoint], None] | None = None
        """Called at every choice, even of one candidate."""
        self.on_lull: Callable[[], None] | None = None
        """Called each time that nothing is left to run."""
        self.has_begun = False
        self._forced: ReadyItem | None = None
        self._held: dict[object, None] = {}
        self._ready = _ReadyQueue(lambda item: self.place(item), self._runs)
        self._tasks = _ReadyQueue(lambda item: self.place(item), self._runs)
        self.ready = self._ready  # type: ignore[assignment]
        self.tasks = self._tasks  # type: ignore[assignment]

    def next_timer(self) -> TimerState | None:
        """Return the next timer; overdue ones wait for a worker."""
        due, after = self.timers.due(self.now_ns)
        if any(self._runs(self.place(timer.owner)) for timer in due):  # type: ignore[arg-type]
            return due[0]
        return after

    def run_step(self) -> None:
        """Run everything that is due at the current time and has a worker."""
        self.has_begun = True
        now_ns = self.now_ns
        scheduled = self.scheduled
        limit = self.events + self._livelock_limit
        while scheduled and scheduled[0][0] <= now_ns and not self._interrupt:
            release = heappop(scheduled)
            receiver = release[3](release)
            if receiver is not None:
                self.ready.append(receiver)
        while not self._interrupt:
            place = self._next()
            if place is not None:
                self._dispatch(place)
            else:
                if self.on_lull is not None:
                    self.on_lull()
                if not self.idle or not self._run_idle():
                    break
            if self.events >= limit:
                if self.now_ns == now_ns:
                    self._livelock(now_ns)
                now_ns = self.now_ns  # a callback has waited, and time has passed meanwhile
                limit = self.events + self._livelock_limit

    def _next(self) -> ReadyItem | None:
        """Take what runs next: tasks first, as rclpy does, then the policy's choice."""
        forced, self._forced = self._forced, None
        if forced is not None:
            self._take_out(forced)
            return forced
        polls = self.polls
        if polls:
            self.hand_over()
        tasks: list[ReadyItem] = []
        for place in self._tasks.runnable():
            if polls and place.candidate.kind == "task":
                tasks.append(place)
                continue
            self._tasks.places.remove(place)
            return place
        places = tasks + self._waiting()
        if not places:
            return None
        place = places[self.choose([place.candidate for place in places])]
        self._take_out(place)
        return place

    def runnable(self) -> list[ReadyItem]:
        """Return all that could run now: tasks, what is ready, and due timers."""
        return [*self._tasks.runnable(), *self._waiting()]

    def starved(self) -> list[ReadyItem]:
        """Return what is ready but finds no free worker."""
        due, _ = self.timers.due(self.now_ns)
        timers = [self.place(timer.owner) for timer in due]  # type: ignore[arg-type]
        every = [*self._tasks.places, *self._ready.places, *timers]
        return [place for place in every if place.workers is not None and place.workers.are_busy]

    def run_next(self, place: ReadyItem) -> None:
        """Run one of ``runnable`` first, after the current event."""
        self._forced = place

    @property
    def polls(self) -> bool:  # type: ignore[override]
        """Whether the policy also orders tasks and the user's own executors."""
        from_ns: int | None = getattr(self.policy, "polls_from_ns", None)
        return from_ns is not None and self.now_ns > from_ns

    def hand_over(self) -> None:
        """Hand what is ready to the user's own executors."""
        due, _ = self.timers.due(self.now_ns)
        timers = [self.place(timer.owner) for timer in due]  # type: ignore[arg-type]
        for place in [*self._tasks.places, *self._ready.places, *timers]:
            item: Dispatchable = place.candidate.item
            if place.handed_over and self.place(item).handed_over:
                self._take_out(place)
                item.dispatch()

    def forget(self, executor: str) -> None:
        """Tell the policy that an executor starts anew."""
        forget = getattr(self.policy, "forget", None)
        if forget is not None:
            forget(executor)

    def choose(self, ready: list[Candidate]) -> int:
        """Return the index of the policy's choice.

        :raises RunError: the policy fails.
        """
        moment = ChoicePoint(self.now_ns, self.events, self.origin_ns)
        choice = self._chosen(ready, moment)
        if self.on_choice is not None:
            self.on_choice(ready, choice, moment)
        if self.choices is not None and len(ready) > 1:
            self.choices.add(choice)
        return choice

    def _waiting(self) -> list[ReadyItem]:
        due, _ = self.timers.due(self.now_ns)
        timers = [self.place(timer.owner) for timer in due]  # type: ignore[arg-type]
        return [*self._ready.runnable(), *filter(self._runs, timers)]

    def _take_out(self, place: ReadyItem) -> None:
        for queue in (self._ready.places, self._tasks.places):
            for index, other in enumerate(queue):
                if other is place:
                    del queue[index]
                    return

    def _chosen(self, ready: list[Candidate], moment: ChoicePoint) -> int:
        name = type(self.policy).__qualname__
        try:
            choice = self.policy.choose(ready, moment)
        except RunError:
            raise
        except Exception as error:
            raise RunError(
                f"the policy {name} raised {type(error).__qualname__}: {error}"
            ) from error
        if not isinstance(choice, int) or not 0 <= choice < len(ready):
            raise RunError(
                f"the policy {name} chose {choice!r} of {len(ready)}: choose must return the index "
                "of one of those that are ready"
            )
        return choice

    def _runs(self, place: ReadyItem) -> bool:
        workers = place.workers
        if workers is not None and workers.are_busy:
            return False
        return place.exclusive is None or place.exclusive not in self._held

    def _dispatch(self, place: ReadyItem) -> None:
        """Run an event and keep its worker busy for its execution time."""
        workers = place.workers
        item: Dispatchable = place.candidate.item
        if workers is None:
            item.dispatch()
            return
        charge = self.charge = ExecutionCharge()
        workers.running += 1
        item.dispatch()  # comes back later in time if the callback has waited for something
        if charge.duration_ns == 0:
            workers.running -= 1
            return
        if place.exclusive is not None:
            self._held[place.exclusive] = None

        def over() -> None:
            workers.running -= 1
            self._held.pop(place.exclusive, None)

        self.schedule(self.now_ns + charge.duration_ns, over)
