"""Callbacks that are ``async def``, and ``create_task``, with rclpy's semantics."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any
from weakref import WeakKeyDictionary

from rsltrace.adapters.rclpy.concurrency.coroutines import CoroutineTask, TaskRun
from rsltrace.adapters.rclpy.concurrency.mailbox import Mailbox
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.trace.model.event import EventKind, OutputKind

_TASK = int(EventKind.TASK)

_is_coroutine: WeakKeyDictionary[FunctionType, bool] = WeakKeyDictionary()


def is_coroutine_function(callback: object) -> bool:
    """Return whether calling ``callback`` gives a coroutine; cached: ``inspect`` is slow, and audit
    hooks are told of who looks at a function's code."""
    function = callback.__func__ if type(callback) is MethodType else callback
    if type(function) is not FunctionType:
        return inspect.iscoroutinefunction(callback)
    known = _is_coroutine.get(function)
    if known is None:
        known = _is_coroutine[function] = inspect.iscoroutinefunction(callback)
    return known


def is_awaited(runtime: Runtime, callback: object) -> bool:
    """Return whether a callback runs as a coroutine: it is one, or ``await_or_execute`` was
    replaced."""
    return runtime.runs_callbacks is not None or is_coroutine_function(callback)


def executor_of(runtime: Runtime, handle: Any) -> Any:
    """Return the executor of a handle's node: one of user code, or the run's."""
    mailbox: Mailbox | None = handle.node.mailbox if handle.node is not None else None
    if mailbox is not None and mailbox.driver is not None:
        return mailbox.driver.executor
    return runtime.executor


def set_executor(waitable: Any, executor: Any) -> None:
    """Give a waitable's futures the executor of their done callbacks, as rclpy's executors do. An
    action server has a future for each goal that it remembers."""
    for future in waitable._futures:
        if future._executor() is not executor:
            future._set_executor(executor)


def run_callback(
    runtime: Runtime,
    handle: Any,
    kind: int,
    callback: Callable[..., Any],
    args: tuple[Any, ...],
    *cause: int,
) -> None:
    """Run an entity's callback as one event. (Hot paths look up ``is_awaited`` once instead.)"""
    if is_awaited(runtime, callback):
        start_callback(runtime, handle, kind, callback, args, *cause)
    else:
        execute = runtime.dispatcher.execute
        execute(handle, handle.entity_id, handle.node, kind, callback, args, *cause)


def start_callback(
    runtime: Runtime,
    handle: Any,
    kind: int,
    callback: Callable[..., Any],
    args: tuple[Any, ...],
    *cause: int,
) -> None:
    """Run an entity's callback that ``is_awaited``, as rclpy's executors would."""
    if runtime.runs_callbacks is not None:
        callback, args = runtime.runs_callbacks, (callback, *args)
    start_coroutine(runtime, handle, kind, callback, args, *cause)


def start_coroutine(
    runtime: Runtime,
    handle: Any,
    kind: int,
    callback: Callable[..., Any],
    args: tuple[Any, ...],
    cause_event: int,
    cause_output: int,
    input_hash: int,
) -> None:
    """Run an entity's ``async def`` callback until it first suspends, as one event."""
    wrapper = handle.wrapper
    group = wrapper.callback_group
    runtime.groups.begin_coroutine(group, wrapper)
    if is_coroutine_function(callback):
        task: Any = CoroutineTask(callback(*args))
    else:  # in place of await_or_execute
        from rclpy.task import Task

        task = Task(callback, args, executor=executor_of(runtime, handle))
    run = TaskRun(
        runtime.coroutines,
        task,
        called=(callback, args),
        entity=handle.entity_id,
        node=handle.node,
        kind=kind,
        label=handle.describe,
        on_end=lambda: runtime.groups.end(group, wrapper),
        mailbox=handle.node.mailbox if handle.node is not None else None,
    )
    run.cause_event, run.cause_output, run.input_hash = cause_event, cause_output, input_hash
    if run.mailbox is None:
        run.dispatch()
    else:
        run.mailbox.run(run)  # its executor has taken it already


def create_task(
    runtime: Runtime,
    callback: Any,
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
    *,
    executor: Any = None,
    mailbox: Mailbox | None = None,
) -> Any:
    """Make a Task of the current event's entity that runs right after the event.

    A user's ``executor`` takes it from ``mailbox``; None is the run's own executor.
    """
    from rclpy.task import Task

    task = Task(callback, args, kwargs, executor=executor or runtime.executor)
    event = runtime.event
    name = getattr(callback, "__qualname__", type(callback).__qualname__)
    owner = event.node.fully_qualified_name if event.node is not None else "the run"
    run = TaskRun(
        runtime.coroutines,
        task,
        called=(callback, args),
        entity=event.entity,
        node=event.node,
        kind=_TASK,
        label=lambda: f"{owner}: task {name}",
        mailbox=mailbox,
    )
    run.cause_output = runtime.dispatcher.note(OutputKind.TASK, event.entity)
    run.input_hash = event.input_hash
    runtime.loop.tasks.append(run)
    return task
