"""Executors of the user's own: rclpy's classes, with the places exchanged where they would wait.

What is exchanged is few and the same in all versions: how an executor learns of nodes, and
``wait_for_ready_callbacks``. The run's own ``SimExecutor`` overrides all of it.
"""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from rsltrace.adapters.rclpy.executors.exchanged import exchanged_function_called, note_exchanged
from rsltrace.adapters.rclpy.executors.pump import pump_of
from rsltrace.adapters.rclpy.handles.waitables import sync_woken
from rsltrace.adapters.rclpy.stacks.blocking_calls import lose_patience
from rsltrace.adapters.rclpy.stacks.coroutines import Resume
from rsltrace.adapters.rclpy.stacks.stacks import Stacks
from rsltrace.adapters.rclpy.stacks.tasks import create_task
from rsltrace.guard.virtual.processors import PROCESSORS


@contextmanager
def own_executors(stacks: Stacks) -> Iterator[None]:
    """Have rclpy's executors wait in simulated time within the ``with`` block."""
    from rclpy import executors
    from rclpy.executors import Executor

    made: list[weakref.ref[Executor]] = []
    real = {name: getattr(Executor, name) for name in _methods(stacks, {}, made)}
    names = ("os", "time")
    saved = {name: getattr(executors, name) for name in names if hasattr(executors, name)}
    for name, method in _methods(stacks, real, made).items():
        setattr(Executor, name, method)
    executors.os = SimpleNamespace(
        sched_getaffinity=lambda pid: set(range(PROCESSORS)), cpu_count=lambda: PROCESSORS
    )
    executors.time = SimpleNamespace(monotonic=lambda: stacks.loop.now_ns / 1_000_000_000)
    try:
        with exchanged_function_called(stacks):
            yield
    finally:
        for name, method in real.items():
            setattr(Executor, name, method)
        for name, value in saved.items():
            setattr(executors, name, value)
        _release(made)


def _release(made: list[weakref.ref[Any]]) -> None:
    """Take from executors that nobody shut down what they would give back to rclpy when collected.

    By then it is the real rclpy again, which never had it.
    """
    for reference in made:
        executor = reference()
        guard = getattr(executor, "_sigint_gc", None)
        if executor is not None and guard is not None:
            guard.handle.destroy_when_not_in_use()
            executor._sigint_gc = None


def _methods(
    stacks: Stacks, real: dict[str, Any], made: list[weakref.ref[Any]]
) -> dict[str, Callable[..., Any]]:
    """Return what stands in for methods of ``Executor``; ``real`` are the originals, ``made``
    gets the executors that are made."""

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        real["__init__"](self, *args, **kwargs)
        made.append(weakref.ref(self))
        note_exchanged(stacks, type(self))
        for guard in (self._guard, getattr(self, "_sigint_gc", None)):
            pending = stacks.domain.entities.pending
            if getattr(guard, "handle", None) in pending:  # they are no entities
                pending.remove(guard.handle)  # type: ignore[union-attr]

    def add_node(self: Any, node: Any) -> bool:
        if stacks.ending.closing:  # ``while True: rclpy.spin(node)`` does nothing else from then on
            lose_patience(stacks)
        added: bool = real["add_node"](self, node)
        if added:
            if node.handle.mailbox is None:  # the first time: ``spin_once`` adds it again and again
                note_exchanged(stacks, type(self))
            pump_of(stacks, self).add(node)
        return added

    def remove_node(self: Any, node: Any) -> None:
        real["remove_node"](self, node)
        pump_of(stacks, self).remove(node)

    def get_nodes(self: Any) -> list[Any]:
        return list(pump_of(stacks, self).nodes)

    def wake(self: Any) -> None:
        pump = pump_of(stacks, self)
        sync_woken(pump.nodes, sys._getframe(1))
        pump.wake()

    def shutdown(self: Any, timeout_sec: float | None = None) -> bool:
        done: bool = real["shutdown"](self, timeout_sec)
        pump_of(stacks, self).close()
        return done

    def make_task(self: Any, callback: Any, *args: Any, **kwargs: Any) -> Any:
        if type(callback) is Resume or is_bookkeeping(callback):
            callback(*args)  # rclpy's own, not an event
            return None
        tasks = pump_of(stacks, self).tasks
        return create_task(stacks, callback, args, kwargs, executor=self, mailbox=tasks)

    def wait_for_ready_callbacks(
        self: Any,
        timeout_sec: Any = None,
        nodes: list[Any] | None = None,
        condition: Callable[[], bool] = lambda: False,
    ) -> tuple[Any, Any, Any]:
        return pump_of(stacks, self).next(timeout_sec, nodes, condition)

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
    """Say whether a done callback is rclpy's own, which is part of an event and none itself."""
    if getattr(callback, "__func__", None) in _bookkeeping():
        return True
    return getattr(callback, "__module__", "") == "rclpy.executors"


@lru_cache(maxsize=1)
def _bookkeeping() -> frozenset[Any]:
    """Return the methods by which rclpy forgets requests that have been answered."""
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
