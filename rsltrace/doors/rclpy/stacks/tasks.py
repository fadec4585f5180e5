"""Tasks and coroutines with rclpy's semantics: create_task, await of futures, done callbacks.

rclpy's executors poll suspended coroutines. Here a coroutine is resumed when the future it awaits
is done; only one that awaits something else than an rclpy Future is polled, once after everything
else at that time has run.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from types import FunctionType, MethodType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from rsltrace.doors.rclpy.boundary import callback_groups as groups
from rsltrace.doors.rclpy.stacks.mailbox import executor_of
from rsltrace.doors.rclpy.stacks.wait_reasons import awaited
from rsltrace.model.event import EventFlag, EventKind, OutputKind

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.boundary.entity_handle import EntityHandle
    from rsltrace.doors.rclpy.boundary.node import NodeHandle
    from rsltrace.doors.rclpy.core import Core
    from rsltrace.doors.rclpy.stacks.mailbox import Mailbox

_TASK = int(EventKind.TASK)
_RESUME = int(EventKind.RESUME)
_SUSPENDED = int(EventFlag.SUSPENDED)


_is_coroutine: WeakKeyDictionary[FunctionType, bool] = WeakKeyDictionary()


def is_coroutine_function(callback: object) -> bool:
    """Return whether calling ``callback`` gives a coroutine; about a method, look only once.

    Looking costs a microsecond, and more where an audit hook is told of each look at code.
    """
    if type(callback) is not MethodType or type(callback.__func__) is not FunctionType:
        return inspect.iscoroutinefunction(callback)
    known = _is_coroutine.get(callback.__func__)
    if known is None:
        known = _is_coroutine[callback.__func__] = inspect.iscoroutinefunction(callback)
    return known


class TaskRun:
    """One rclpy Task under way: started once, resumed as often as it awaits.

    ``cause_event``, ``cause_output`` and ``input_hash`` belong to the next dispatch.
    """

    def __init__(
        self,
        core: Core,
        task: Any,
        *,
        entity: int,
        node: NodeHandle | None,
        kind: int,
        label: Callable[[], str],
        on_end: Callable[[], None] | None = None,
        mailbox: Mailbox | None = None,
    ) -> None:
        self.core = core
        self.mailbox = mailbox
        self.task = task
        self.entity = entity
        self.node = node
        self.kind = kind
        self.label = label
        self.cause_event = core.loop.events
        self.cause_output = 0
        self.input_hash = 0
        self._on_end = on_end
        self._awaited: Any = None

    def dispatch(self) -> None:
        """Run the task's next stretch."""
        if self.mailbox is not None and self.mailbox.keeps(self):
            return
        if self.task.done() or self.task.cancelled():
            self._end()
            return
        kind, self.kind = self.kind, _RESUME
        self.core.execute(
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

    def describe(self) -> str:
        """Name the task and where it came from."""
        return self.label()

    def waits_for(self) -> str:
        """Say what a suspended task waits for, and where in the code."""
        frame = getattr(self.task._handler, "cr_frame", None)
        where = f" at {frame.f_code.co_filename}:{frame.f_lineno}" if frame is not None else ""
        return f"{self.label()} waits{where} for {awaited(self.core, self._awaited)}"

    def _step(self) -> None:
        core = self.core
        core.suspended.pop(self, None)
        self._awaited = None
        task = self.task
        task()
        if task.done() or task.cancelled():
            self._end()
            error = task.exception()
            if error is not None:
                raise error
            return
        core.flags |= _SUSPENDED
        core.suspended[self] = None
        self._awaited = awaited_future(task._handler)
        if self._awaited is None:
            core.polled.append(self)
            if not core.polling:
                core.polling = True
                core.loop.idle.append(partial(poll, core))
        else:
            self._awaited.add_done_callback(Resume(self))

    def _end(self) -> None:
        self.core.suspended.pop(self, None)
        if self._on_end is not None:
            on_end, self._on_end = self._on_end, None
            on_end()


class Resume:
    """The done callback that puts a suspended task back among the tasks."""

    def __init__(self, run: TaskRun) -> None:
        self._run = run

    def __call__(self, future: Any) -> None:
        run, core = self._run, self._run.core
        run.cause_event = core.loop.events
        run.cause_output = core.note(OutputKind.TASK, run.entity, 1)
        run.input_hash = core.input_hash
        core.loop.tasks.append(run)


def start_coroutine(
    core: Core,
    handle: EntityHandle,
    kind: int,
    callback: Callable[..., Any],
    args: tuple[Any, ...],
    cause_event: int,
    cause_output: int,
    input_hash: int,
) -> None:
    """Run an entity's ``async def`` callback up to its first suspension, as one event."""
    from rclpy.task import Task

    wrapper = handle.wrapper
    run = TaskRun(
        core,
        Task(callback, args, None, executor=executor_of(core, handle)),
        entity=handle.entity_id,
        node=handle.node,
        kind=kind,
        label=handle.describe,
        on_end=lambda: groups.end(core, wrapper.callback_group, wrapper),
        mailbox=handle.node.mailbox if handle.node is not None else None,
    )
    run.cause_event, run.cause_output, run.input_hash = cause_event, cause_output, input_hash
    if run.mailbox is None:
        run.dispatch()
    else:
        run.mailbox.run(run)  # the executor has it under way already


def create_task(
    core: Core,
    callback: Any,
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
    *,
    executor: Any = None,
    mailbox: Mailbox | None = None,
) -> Any:
    """Make a Task that runs right after the present event; it belongs to that event's entity.

    ``executor`` runs it: one of the user's own takes it from ``mailbox``, None is the run's.
    """
    from rclpy.task import Task

    task = Task(callback, args, kwargs, executor=executor or core.executor)
    entity, node = core.current_entity, core.current_node
    name = getattr(callback, "__qualname__", type(callback).__qualname__)
    owner = node.fully_qualified_name if node is not None else "the run"
    run = TaskRun(
        core,
        task,
        entity=entity,
        node=node,
        kind=_TASK,
        label=lambda: f"{owner}: task {name}",
        mailbox=mailbox,
    )
    run.cause_output = core.note(OutputKind.TASK, entity)
    run.input_hash = core.input_hash
    core.loop.tasks.append(run)
    return task


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


def poll(core: Core) -> bool:
    """Give coroutines that await something else one more try; True if there were any.

    Once per stretch of other work: those that yield again wait until something else has happened.
    """
    stage = (core.loop.now_ns, core.loop.events - core.polls)
    if not core.polled or stage == core.poll_stage:
        return False
    core.poll_stage = stage
    runs, core.polled = core.polled, []
    core.polls += len(runs)
    for run in runs:
        run.cause_event, run.cause_output = 2**64 - 1, 0
        core.loop.tasks.append(run)
    return True
