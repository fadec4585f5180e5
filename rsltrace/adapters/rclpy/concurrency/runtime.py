"""The runtime of user code in one run: blocked calls, and the call stacks (greenlets) they wait on.

All simulated threads share one real thread. When a callback blocks, its stack is suspended and
another stack takes over the loop. When the wait is over, that stack switches back to the callback,
which finishes and then runs the loop itself. Callbacks that do not block (nearly all) involve none
of this.
"""

from __future__ import annotations

import itertools
import os
import traceback
from _thread import get_ident
from collections.abc import Callable
from dataclasses import field
from typing import Any, Protocol
from weakref import WeakKeyDictionary

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.concurrency.callback_groups import CallbackGroups
from rsltrace.adapters.rclpy.concurrency.coroutines import Coroutines
from rsltrace.adapters.rclpy.concurrency.mailbox import describe_service_call
from rsltrace.adapters.rclpy.concurrency.program import SimulatedProgram, SimulatedPrograms
from rsltrace.errors import EXIT_RUN
from rsltrace.fast_dataclass import dataclass
from rsltrace.guard.callers import is_user_or_library_file
from rsltrace.simulation.loop.loop import NOTHING_LEFT
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.entity import Runnable
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind

_RESUME = int(EventKind.RESUME)

Patience = bool | Callable[[], bool]
"""Whether a wait may last for ever, or a function that returns it."""


class RunEnded(BaseException):
    """Raised in a blocked call when the run ends, so that ``finally`` blocks run."""


class LoopStacks:
    """The stacks that run the loop: ``waiting`` are those that wait to run it again, ``main`` is
    the first. Nothing in another ``process`` or real ``thread`` is simulated."""

    def __init__(
        self,
        domain: Domain,
        programs: SimulatedPrograms,
        groups: CallbackGroups,
        run: Callable[[], None],
    ) -> None:
        self.domain = domain
        self.programs = programs
        self.groups = groups
        self.process = os.getpid()
        self.thread = get_ident()
        self.blocked: dict[BlockedCall, None] = {}
        self.main: greenlet | None = None
        self.waiting: list[greenlet] = []
        self.error: BaseException | None = None
        self.numbers: WeakKeyDictionary[greenlet, int] | None = None
        """Numbers of stacks that could switch at a line, if threads do."""
        self._next_number = itertools.count(1).__next__
        self._run = run
        self._maker: greenlet | None = None

    def next(self) -> greenlet:
        """Return the stack that runs the loop when a callback blocks.

        New stacks all begin on the stack of one maker, so that however many calls are blocked, the
        next callback does not run deeper (in Python's recursion limit, and in C).
        """
        if self.waiting:
            return self.waiting.pop()
        if self._maker is None:
            self._maker = greenlet(self._make, self.main)
        return self._maker

    def close(self) -> None:
        """Drop the maker, which would keep this world alive."""
        maker, self._maker = self._maker, None
        if maker is not None:
            maker.throw()

    def _make(self) -> None:
        while True:
            greenlet(self._run, self.main).switch()

    def number_of(self, stack: greenlet) -> int:
        """Return the number of a stack; 0 if stacks have none."""
        if self.numbers is None:
            return 0
        number = self.numbers.get(stack)
        if number is None:
            number = self.numbers[stack] = self._next_number()
        return number

    def step_aside(self) -> None:
        """Let the stack that switched to the current one go on when this ends."""
        getcurrent().parent = self.waiting.pop()


class BlockedCall:
    """One blocked call. ``wake`` makes it ready; it is dispatched like an event."""

    def __init__(
        self, runners: LoopStacks, what: object, group: object, *, quiet: bool, patient: Patience
    ) -> None:
        domain, programs = runners.domain, runners.programs
        event = domain.event
        self._runners = runners
        self.what = what
        self._patient = patient
        self.error: BaseException | None = None
        """The exception that the call raises when it goes on."""
        self.program = programs.present
        self.since_ns = domain.loop.now_ns
        self.deadline_ns: int | None = None
        self.quiet = quiet
        self.group = group
        """The callback group that the wait keeps busy, or None."""
        self.stack = getcurrent()
        self.timed_out = False
        self.woken = False
        """Whether the call may return."""
        self.event = (event.handle, event.entity, event.node)
        """The event that waits: handle, entity and node."""
        self.constructing = programs.constructing
        """The entry under construction where it waits."""
        self._end_group = event.on_end
        self._cause = (NO_EVENT, 0)
        self._input_hash = 0
        self._busy_ns = event.busy_ns

    @property
    def entity_id(self) -> int:
        """The entity whose callback waits."""
        return self.event[1]

    @property
    def waiting(self) -> bool:
        return not self.woken

    def stop_waiting(self) -> None:
        """Ignore later wake-ups."""
        self.woken = True

    def is_patient(self) -> bool:
        """Return whether the call may wait for ever (for more work, say)."""
        patient, self._patient = self._patient, False  # False, if asked in a circle
        try:
            return patient if isinstance(patient, bool) else patient()
        finally:
            self._patient = patient

    def wake(self) -> None:
        """Let the call return because of the current event."""
        if not self.woken:
            self.woken = True
            domain = self._runners.domain
            position = domain.dispatcher.note(OutputKind.TASK, self.event[1], 2)
            self._cause = (domain.loop.events, position)
            self._input_hash = domain.event.input_hash
            domain.loop.tasks.append(self)

    def release(self) -> None:
        """Let the call return without a causing event."""
        if not self.woken:
            self.woken = True
            self._runners.domain.loop.tasks.append(self)

    def time_out(self) -> None:
        """Let the call return because of its timeout."""
        if not self.woken:
            self.woken = self.timed_out = True
            self._runners.domain.loop.ready.append(self)

    def give_way(self, output: int) -> None:
        """Let the call return when it is its turn; ``output`` of the current event is the cause."""
        self.woken = True
        self._cause = (self._runners.domain.loop.events, output)
        self._runners.domain.loop.ready.append(self)

    @property
    def held(self) -> list[Any] | None:
        """The list that keeps it while its process hangs or after a crash, else None."""
        held = self.program.held
        return held if held is not None or self.event[2] is None else self.event[2].held

    def dispatch(self) -> None:
        """Switch from the stack that runs the loop to the blocked call."""
        if (held := self.held) is not None:
            held.append(self)
            return
        self._runners.waiting.append(getcurrent())
        self.stack.switch()

    def resumed(self) -> None:
        """Begin the RESUME event, on the stack of the blocked call."""
        dispatcher, programs = self._runners.domain.dispatcher, self._runners.programs
        event = dispatcher.event
        event.handle, event.entity, event.node = self.event
        for observer in dispatcher.node_observers:
            observer.node_entered(event.node, is_made=False)
        event.kind = _RESUME
        event.cause_event, event.cause_output = self._cause
        event.input_hash = self._input_hash
        programs.constructing = self.constructing
        event.on_end = self._end_group
        event.quiet = self.quiet
        event.busy_ns = self._busy_ns
        if self.program is not programs.present:
            self.program.enter()
        for observer in dispatcher.resume_observers:
            observer.resumed()

    def follow(self, event: int) -> None:
        """Make ``event``, which has run on the stack meanwhile, the cause."""
        self._cause = (event, 0)

    def runnable(self) -> Runnable:
        """Describe it to a policy: it already has its worker."""
        thread = self._runners.number_of(self.stack)
        return Runnable("resume", "", self.entity_id, thread=thread)

    def describe(self) -> str:
        return self.event[0].describe() if self.event[0] is not None else "the run"

    def waits_for(self) -> str:
        """Describe who waits for what, with the lines of user code."""
        frames = traceback.extract_stack(self.stack.gr_frame) if self.stack.gr_frame else []
        own = [frame for frame in frames if is_user_or_library_file(frame.filename)]
        where = "".join(f"\n    at {f.filename}:{f.lineno} in {f.name}" for f in own[-4:])
        hint = ""
        if self.group is not None and self._runners.groups.waiting_for(self.group):
            hint = (
                ", which may be one of the events that wait for its callback group: a blocked "
                "callback keeps a mutually exclusive group busy, so give the client, timer or "
                "subscription it waits for a callback group of its own"
            )
        graph = self._runners.domain.graph
        what = describe_service_call(graph, self.stack.gr_frame) or self.what
        return f"{self.describe()} waits for {what}{hint}{where}"


class UserThread(Protocol):
    """A thread that user code has started."""

    ident: int
    daemon: bool
    ended: bool
    program: SimulatedProgram
    node: Any
    thread: Any

    def join(self, timeout: float | None) -> None:
        """Wait until it has ended."""

    def dismiss(self) -> None:
        """Let the worker of a pool end after its work."""

    def end(self) -> None:
        """Mark it as ended."""


class UserThreads:
    """The running threads of user code, and their stacks."""

    def __init__(self) -> None:
        self.alive: dict[UserThread, None] = {}
        self.by_stack: dict[greenlet, UserThread] = {}
        self.count = 0

    def runs_on(self, stack: greenlet) -> bool:
        return stack in self.by_stack


@dataclass(slots=True)
class RunEnding:
    """The stages of the end of a run. ``closing``: mains are interrupted. ``unwinding``: blocked
    calls raise ``RunEnded``. ``stuck`` describes the waiting calls of a deadlock.

    ``grace_ns`` and ``shutdown_ns``: how long mains and ``destroy_node`` have slept since, while
    time stands still. ``refused`` counts waits after the end.
    """

    closing: bool = False
    unwinding: bool = False
    stuck: list[str] = field(default_factory=list)
    grace_ns: int = 0
    shutdown_ns: int = 0
    refused: int = 0


class Runtime:
    """The state of user code in one run; each attribute is explained at its class.

    ``executor`` is the rclpy Executor of the nodes that the job constructs.
    """

    def __init__(self, domain: Domain) -> None:
        self.domain = domain
        self.loop = domain.loop
        self.dispatcher = domain.dispatcher
        self.event = domain.event
        self.ending = RunEnding()
        self.groups = CallbackGroups(domain)
        self.programs = SimulatedPrograms()
        self.threads = UserThreads()
        self.coroutines = Coroutines(domain)
        self.runners = LoopStacks(domain, self.programs, self.groups, self._take_over)
        self.executor: Any = None
        self.runs_callbacks: Any = None
        """The function that user code put in place of rclpy's ``await_or_execute``, if any."""

    def _take_over(self) -> None:
        """Run the loop on another stack, because a callback blocked.

        When the loop ends, the stack that began the run goes on.
        """
        runners = self.runners
        try:
            self.loop.run()
            self.domain.outcome.note_end(self.loop.events)
            self._note_stuck()
        except RunEnded:
            pass
        except BaseException as error:
            runners.error = error
            self.loop.stop(Stop("the run failed", EXIT_RUN))
        if any(blocked.stack is runners.main for blocked in runners.blocked):
            self.ending.unwinding = True
        getcurrent().parent = runners.main

    def _note_stuck(self) -> None:
        """Note the waiting calls if the run ended for lack of events."""
        stopped = self.loop.stopped
        if stopped is not None and stopped.reason == NOTHING_LEFT and not self.ending.stuck:
            self.ending.stuck = self.who_waits()

    def who_waits(self) -> list[str]:
        """Describe what every suspended coroutine and blocked call waits for."""
        suspended = [run for run in self.coroutines.suspended if not run.task.cancelled()]
        blocked = [one for one in self.runners.blocked if one.held is None]  # does not hang
        waits = [run.waits_for() for run in suspended if run.node is None or run.node.held is None]
        waits += [one.waits_for() for one in blocked if not one.is_patient()]
        notes = self.domain.outcome.notes
        return waits + [f"(before: {note})" for note in notes] if waits else []
