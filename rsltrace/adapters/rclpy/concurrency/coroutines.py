"""Coroutines of user code: started once, resumed when the future they await is done.

rclpy's executors poll suspended coroutines. Here a coroutine is polled only if it awaits something
other than an rclpy Future, once after everything else at that time has run.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from rsltrace.adapters.rclpy.concurrency.code_lines import FunctionRecorder
from rsltrace.adapters.rclpy.concurrency.mailbox import Mailbox, describe_awaited
from rsltrace.simulation.middleware.domain import Domain
from rsltrace.simulation.middleware.entity import Runnable
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.trace.model.operation import RESUMES_COROUTINE

_TASK = int(EventKind.TASK)
_RESUME = int(EventKind.RESUME)
_SUSPENDED = int(EventFlag.SUSPENDED)


class Coroutines:
    """The suspended coroutines of one run, and those that are polled."""

    def __init__(self, domain: Domain) -> None:
        self.domain = domain
        self.suspended: dict[TaskRun, None] = {}
        self.functions = FunctionRecorder(domain.dispatcher)
        self._polled: list[TaskRun] = []
        self._polls = 0
        self._stage: tuple[int, int] | None = None
        self._polling = False

    def poll_later(self, run: TaskRun) -> None:
        """Resume a coroutine when nothing else is ready."""
        self._polled.append(run)
        if not self._polling:
            self._polling = True
            self.domain.loop.idle.append(self._poll)

    def _poll(self) -> bool:
        """Resume the polled coroutines; return whether there were any.

        Those that yield again wait until something else has happened.
        """
        loop = self.domain.loop
        stage = (loop.now_ns, loop.events - self._polls)
        if not self._polled or stage == self._stage:
            return False
        self._stage = stage
        runs, self._polled = self._polled, []
        self._polls += len(runs)
        for run in runs:
            run.cause_event, run.cause_output = NO_EVENT, 0
            loop.tasks.append(run)
        return True


class CoroutineTask:
    """An entity's coroutine, as a Task. Neither rclpy nor user code gets hold of it, so it needs no
    locks, result or done callbacks, which take rclpy's Task most of its time."""

    __slots__ = ("_error", "_handler", "_is_cancelled", "_is_done")

    def __init__(self, coroutine: Any) -> None:
        self._handler = coroutine
        self._error: Exception | None = None
        self._is_done = False
        self._is_cancelled = False

    def __call__(self) -> None:
        """Run or resume it."""
        try:
            self._handler.send(None)
            return
        except StopIteration:
            pass
        except Exception as error:
            self._error = error
        self._is_done = True
        self._handler = None

    def done(self) -> bool:
        return self._is_done

    def cancelled(self) -> bool:
        return self._is_cancelled

    def exception(self) -> Exception | None:
        return self._error

    def cancel(self) -> None:
        self._is_cancelled = True


class TaskRun:
    """An rclpy Task, or a ``CoroutineTask``, that was started. ``called`` is its function with
    arguments; ``cause_event``, ``cause_output`` and ``input_hash`` are those of its next event."""

    def __init__(
        self,
        coroutines: Coroutines,
        task: Any,
        *,
        called: tuple[Callable[..., Any], tuple[Any, ...]],
        entity: int,
        node: Any,
        kind: int,
        label: Callable[[], str],
        on_end: Callable[[], None] | None = None,
        mailbox: Mailbox | None = None,
    ) -> None:
        self._coroutines = coroutines
        self.domain = coroutines.domain
        self.mailbox = mailbox
        self.task = task
        self.called = called
        self.entity = entity
        self.node = node
        self.kind = kind
        self.label = label
        self.number = self.domain.loop.next_place()
        """Its place in the order of all tasks."""
        self.cause_event = self.domain.loop.events
        self.cause_output = 0
        self.input_hash = 0
        self._on_end = on_end
        self._is_recorded = kind != _TASK  # others run their entity's callback
        self._awaited: Any = None

    def dispatch(self) -> None:
        if self.node is not None and self.node.held is not None:
            self.node.held.append(self)
            return
        if self.mailbox is not None and self.mailbox.keeps(self):
            return
        if self.task.done() or self.task.cancelled():
            self._end()
            return
        kind, self.kind = self.kind, _RESUME
        self.domain.dispatcher.execute(
            self,
            self.entity,
            self.node,
            kind,
            self._step,
            (),
            self.cause_event,
            self.cause_output,
            self.input_hash,
        )

    @property
    def oldest_first(self) -> bool:
        """Whether this rclpy runs the oldest task first, as releases after Jazzy do."""
        return _run_oldest_first()

    def describe(self) -> str:
        return self.label()

    def runnable(self) -> Runnable:
        node = self.node
        return Runnable(
            "task",
            self.label(),
            self.entity,
            node,
            period_ns=None if node is None else node.shortest_period_ns(),
            executor=node is None or getattr(node, "mailbox", None) is None,
            thread=self.number,
            handed_over=self.mailbox is not None,
        )

    def execution_name(self) -> tuple[str, str]:
        """Return the kind and name by which execution times are configured."""
        return "task", ""

    def waits_for(self) -> str:
        """Describe what a suspended task waits for, and where in the code."""
        frame = getattr(self.task._handler, "cr_frame", None)
        where = f" at {frame.f_code.co_filename}:{frame.f_lineno}" if frame is not None else ""
        return (
            f"{self.label()} waits{where} for {describe_awaited(self.domain.graph, self._awaited)}"
        )

    def _step(self) -> None:
        coroutines = self._coroutines
        coroutines.suspended.pop(self, None)
        if not self._is_recorded:
            self._is_recorded = True
            coroutines.functions.run(self.entity, *self.called)
        self._awaited = None
        task = self.task
        task()
        if task.done() or task.cancelled():
            self._end()
            error = task.exception()
            if error is not None:
                raise error
            return
        self.domain.event.flags |= _SUSPENDED
        coroutines.suspended[self] = None
        self._awaited = awaited_future(task._handler)
        if self._awaited is None:
            coroutines.poll_later(self)
        else:
            self._awaited.add_done_callback(ResumeTask(self))

    def _end(self) -> None:
        self._coroutines.suspended.pop(self, None)
        if self._on_end is not None:
            on_end, self._on_end = self._on_end, None
            on_end()


@lru_cache(maxsize=1)
def _run_oldest_first() -> bool:
    from rclpy.executors import Executor

    wait = getattr(Executor, "_wait_for_ready_callbacks", None)
    return wait is None or "reversed(tasks)" not in inspect.getsource(wait)


class ResumeTask:
    """The done callback that puts a suspended task back among the tasks."""

    def __init__(self, run: TaskRun) -> None:
        self._run = run

    def __call__(self, future: Any) -> None:
        run, domain = self._run, self._run.domain
        run.cause_event = domain.loop.events
        run.cause_output = domain.dispatcher.note(OutputKind.TASK, run.entity, RESUMES_COROUTINE)
        run.input_hash = domain.event.input_hash
        domain.loop.tasks.append(run)


def awaited_future(coroutine: Any) -> Any:
    """Return the rclpy Future at the end of a suspended coroutine's chain of awaits, or None."""
    from rclpy.task import Future

    code = Future.__await__.__code__
    while coroutine is not None:
        if getattr(coroutine, "gi_code", None) is code:
            frame = coroutine.gi_frame
            return frame.f_locals.get("self") if frame is not None else None
        for attribute in ("cr_await", "gi_yieldfrom", "ag_await"):
            if hasattr(coroutine, attribute):
                coroutine = getattr(coroutine, attribute)
                break
        else:
            return None
    return None
