"""Executors that user code makes: rclpy's classes, with a few methods replaced for a run.

The replaced methods are those that add nodes, wake and shut down, and ``wait_for_ready_callbacks``.
``SimExecutor`` overrides all of them.
"""

from __future__ import annotations

import os
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from importlib import import_module
from pathlib import PurePath
from types import ModuleType
from typing import Any

from rsltrace.adapters.rclpy.concurrency.blocking_calls import count_refused_wait
from rsltrace.adapters.rclpy.concurrency.coroutines import ResumeTask
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.concurrency.tasks import create_task
from rsltrace.adapters.rclpy.executors.executor_driver import driver_of
from rsltrace.adapters.rclpy.handles.wait_set import sync_woken
from rsltrace.guard.redirect import module_with, replace_attribute
from rsltrace.guard.virtual.processors import PROCESSORS
from rsltrace.simulation.middleware.interface import imported_file
from rsltrace.trace.model.finding import EXECUTOR, NEVER_CALLED

# Monitoring libraries wrap the functions by which rclpy's executors run callbacks. The loop does
# not call these. A replaced ``await_or_execute`` is called; the run reports the others.

_THROUGH = "await_or_execute"
_ASKED_BY_SPINS = "wait_for_ready_callbacks"
_OWN = (
    ("rclpy", "executors.py"),
    ("rclpy", "callback_groups.py"),
    ("executors", "user_executors.py"),
)


@contextmanager
def replaced_function_called(runtime: Runtime) -> Iterator[None]:
    """Run callbacks through the function that user code puts in place of ``await_or_execute``."""
    from rclpy import executors

    def look() -> None:
        through = getattr(executors, _THROUGH)
        runtime.runs_callbacks = None if _is_rclpys(through) else through
        for node in runtime.domain.graph.nodes:
            wrapper = getattr(node, "wrapper", None)
            for one in [*wrapper.subscriptions, *wrapper.timers] if wrapper is not None else ():
                one.handle.forget_callback()

    class Watched(ModuleType):
        def __setattr__(self, name: str, value: object) -> None:
            super().__setattr__(name, value)
            if name == _THROUGH:
                look()

    kind = type(executors)
    executors.__class__ = Watched
    look()
    try:
        yield
    finally:
        executors.__class__ = kind


def note_replaced_functions(
    runtime: Runtime, executor: type | None = None, *, hosted: bool = False
) -> None:
    """Report functions that user code replaced and that are never called.

    The bases of the class ``executor`` are checked, too. ``hosted``: the job constructs nodes.
    """
    notes = runtime.domain.outcome.notes
    found = [
        f"{_where(function)}: {kind.__qualname__}.{name} is never called, because rsltrace runs "
        "callbacks itself; replace rclpy.executors.await_or_execute instead, or wrap the callbacks"
        for kind, names in _checked_classes(executor)
        for name in names
        if not _is_rclpys(function := vars(kind).get(name))
    ]
    if hosted and not _is_rclpys(spin := vars(_named(EXECUTOR))[_ASKED_BY_SPINS]):
        found.append(
            f"{_where(spin)}: Executor.{_ASKED_BY_SPINS} is not called for nodes that the job "
            "constructs (node:), only for nodes that a main: spins"
        )
    notes += [note for note in dict.fromkeys(found) if note not in notes]


def _checked_classes(executor: type | None) -> Iterator[tuple[type, tuple[str, ...]]]:
    for place, names in NEVER_CALLED.items():
        yield _named(place), names
    for kind in executor.__mro__ if executor is not None else ():
        if kind.__module__ != EXECUTOR.rpartition(".")[0]:
            yield kind, NEVER_CALLED[EXECUTOR]


def _named(place: str) -> Any:
    module, _, name = place.rpartition(".")
    return getattr(import_module(module), name)


def _is_rclpys(function: Any) -> bool:
    """Return whether a function is None, rclpy's or its replacement here.

    ``functools.wraps`` copies names, but not code.
    """
    code = getattr(function, "__code__", None)
    parts = PurePath(code.co_filename).parts[-2:] if code is not None else ()
    return function is None or parts in _OWN


def _where(function: Any) -> str:
    code = getattr(function, "__code__", None)
    if code is None:
        return f"a {type(function).__qualname__}"
    return f"{imported_file(code, function.__globals__)}:{code.co_firstlineno}"


@contextmanager
def own_executors(runtime: Runtime) -> Iterator[None]:
    """Have rclpy's executors wait in simulated time within the ``with`` block."""
    from rclpy import executors
    from rclpy.executors import Executor

    made: list[weakref.ref[Executor]] = []
    real = {name: getattr(Executor, name) for name in _methods(runtime, {}, made)}
    modules = {
        "os": module_with(
            os, sched_getaffinity=lambda pid: set(range(PROCESSORS)), cpu_count=lambda: PROCESSORS
        ),
        "time": module_with(time, monotonic=lambda: runtime.loop.now_ns / 1_000_000_000),
    }
    with ExitStack() as stack:
        stack.callback(_release, made)
        for name, value in modules.items():
            if hasattr(executors, name):
                replace_attribute(stack, executors, name, value)
        for name, method in _methods(runtime, real, made).items():
            replace_attribute(stack, Executor, name, method)
        stack.enter_context(replaced_function_called(runtime))
        yield


def _release(made: list[weakref.ref[Any]]) -> None:
    """Take the guard conditions of executors that were not shut down: the real rclpy, which never
    had them, would get them back when the executors are collected."""
    for reference in made:
        executor = reference()
        guard = getattr(executor, "_sigint_gc", None)
        if executor is not None and guard is not None:
            guard.handle.destroy_when_not_in_use()
            executor._sigint_gc = None


def _methods(
    runtime: Runtime, real: dict[str, Any], made: list[weakref.ref[Any]]
) -> dict[str, Callable[..., Any]]:
    """Return the replacements of ``Executor`` methods. ``real`` are the originals; executors that
    are made are added to ``made``."""

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        real["__init__"](self, *args, **kwargs)
        made.append(weakref.ref(self))
        note_replaced_functions(runtime, type(self))
        for guard in (self._guard, getattr(self, "_sigint_gc", None)):
            pending = runtime.domain.entities.pending
            if getattr(guard, "handle", None) in pending:  # they are no entities
                pending.remove(guard.handle)  # type: ignore[union-attr]

    def add_node(self: Any, node: Any) -> bool:
        if (
            runtime.ending.closing
        ):  # ``while True: rclpy.spin(node)`` does nothing else from then on
            count_refused_wait(runtime)
        added: bool = real["add_node"](self, node)
        if added:
            if node.handle.mailbox is None:  # the first time: ``spin_once`` adds it again and again
                note_replaced_functions(runtime, type(self))
            driver_of(runtime, self).add(node)
        return added

    def remove_node(self: Any, node: Any) -> None:
        real["remove_node"](self, node)
        driver_of(runtime, self).remove(node)

    def get_nodes(self: Any) -> list[Any]:
        return list(driver_of(runtime, self).nodes)

    def wake(self: Any) -> None:
        driver = driver_of(runtime, self)
        sync_woken(driver.nodes, sys._getframe(1))
        driver.wake()

    def shutdown(self: Any, timeout_sec: float | None = None) -> bool:
        done: bool = real["shutdown"](self, timeout_sec)
        driver_of(runtime, self).close()
        return done

    def make_task(self: Any, callback: Any, *args: Any, **kwargs: Any) -> Any:
        if type(callback) is ResumeTask or is_bookkeeping(callback):
            callback(*args)  # rclpy's own, not an event
            return None
        tasks = driver_of(runtime, self).tasks
        return create_task(runtime, callback, args, kwargs, executor=self, mailbox=tasks)

    def wait_for_ready_callbacks(
        self: Any,
        timeout_sec: Any = None,
        nodes: list[Any] | None = None,
        condition: Callable[[], bool] = lambda: False,
    ) -> tuple[Any, Any, Any]:
        return driver_of(runtime, self).next(timeout_sec, nodes, condition)

    return {
        "__init__": __init__,
        "add_node": add_node,
        "remove_node": remove_node,
        "get_nodes": get_nodes,
        "wake": wake,
        "shutdown": shutdown,
        "create_task": make_task,
        "wait_for_ready_callbacks": wait_for_ready_callbacks,
    }


def is_bookkeeping(callback: Any) -> bool:
    """Return whether a done callback is rclpy's own, which is no event of its own."""
    if getattr(callback, "__func__", None) in _bookkeeping():
        return True
    return getattr(callback, "__module__", "") == "rclpy.executors"


@lru_cache(maxsize=1)
def _bookkeeping() -> frozenset[Any]:
    """Return the methods by which rclpy forgets answered requests."""
    from rclpy.action import ActionClient
    from rclpy.client import Client

    return frozenset(
        {
            Client.remove_pending_request,
            ActionClient._remove_pending_goal_request,
            ActionClient._remove_pending_cancel_request,
            ActionClient._remove_pending_result_request,
        }
    )
