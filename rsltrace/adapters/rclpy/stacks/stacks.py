"""The call stacks of user code in one run: who blocks, who is suspended, whose process it is."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

from greenlet import getcurrent, greenlet

from rsltrace.adapters.rclpy.stacks.callback_groups import CallbackGroups
from rsltrace.adapters.rclpy.stacks.coroutines import Coroutines
from rsltrace.adapters.rclpy.stacks.program import Program, Programs
from rsltrace.adapters.rclpy.stacks.runners import RunEnded, Runners
from rsltrace.errors import EXIT_RUN
from rsltrace.simulation.loop.loop import NOTHING_LEFT
from rsltrace.simulation.loop.stop import Stop
from rsltrace.simulation.middleware.domain import Domain


class Thread(Protocol):
    """A thread that user code has started."""

    ident: int
    daemon: bool
    ended: bool
    program: Program
    node: Any
    thread: Any

    def join(self, timeout: float | None) -> None:
        """Wait until it has ended."""

    def dismiss(self) -> None:
        """Let it end when it has done its work."""

    def end(self) -> None:
        """Take note that it has ended."""


class Threads:
    """The threads of user code that have not ended, and the stacks they run on."""

    def __init__(self) -> None:
        self.alive: dict[Thread, None] = {}
        self.by_stack: dict[greenlet, Thread] = {}
        self.count = 0

    def runs_on(self, stack: greenlet) -> bool:
        """Return whether a stack is that of a thread which user code has started."""
        return stack in self.by_stack


@dataclass(slots=True)
class Ending:
    """How far the end of a run is. ``closing``: mains are told to end, and do. ``unwinding``:
    nothing waits any more, blocked calls raise ``RunEnded``. ``stuck`` says who still waited when
    nothing could happen any more.

    ``grace_ns`` and ``shutdown_ns`` are how long mains and ``destroy_node`` have slept since, while
    time stands still; ``refused`` counts the waits of those who go on regardless.
    """

    closing: bool = False
    unwinding: bool = False
    stuck: list[str] = field(default_factory=list)
    grace_ns: int = 0
    shutdown_ns: int = 0
    refused: int = 0


class Stacks:
    """What the stacks of user code have to do with: each value has one job, see its class.

    ``executor`` is the rclpy Executor of the nodes that the job constructs.
    """

    def __init__(self, domain: Domain) -> None:
        self.domain = domain
        self.loop = domain.loop
        self.dispatcher = domain.dispatcher
        self.event = domain.event
        self.ending = Ending()
        self.groups = CallbackGroups(domain)
        self.programs = Programs()
        self.threads = Threads()
        self.coroutines = Coroutines(domain)
        self.runners = Runners(domain, self.programs, self.groups, self._take_over)
        self.executor: Any = None
        self.runs_callbacks: Any = None
        """What user code has put in place of rclpy's ``await_or_execute``, if it has."""

    def _take_over(self) -> None:
        """Run the loop on a stack of its own, because its runner's callback has blocked.

        When the loop ends, whatever stack it ran on, the stack that began the run goes on.
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
        """Remember who still waits if the run has ended because nothing can happen any more."""
        stopped = self.loop.stopped
        if stopped is not None and stopped.reason == NOTHING_LEFT and not self.ending.stuck:
            self.ending.stuck = self.who_waits()

    def who_waits(self) -> list[str]:
        """Say of every suspended coroutine and blocked call what it waits for."""
        suspended = [run for run in self.coroutines.suspended if not run.task.cancelled()]
        blocked = [one for one in self.runners.blocked if one.held is None]  # does not hang
        waits = [run.waits_for() for run in suspended if run.node is None or run.node.held is None]
        waits += [one.waits_for() for one in blocked if not one.is_patient()]
        notes = self.domain.outcome.notes
        return waits + [f"(before: {note})" for note in notes] if waits else []
