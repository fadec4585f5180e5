"""rclpy's single-threaded executor, but that the most urgent of what is ready runs next."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rclpy.executors import (
    ConditionReachedException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)

from rsltrace.native.priorities import Priorities


class PriorityExecutor(SingleThreadedExecutor):  # type: ignore[misc]
    """Looks what is ready before each callback, and runs the most urgent, of equals the first.

    What is under way already (a task, a callback that awaited something) goes before, as rclpy has
    it. A callback is never interrupted.
    """

    _tasks: list[tuple[Any, Any, Any]]

    def __init__(self, priorities: Priorities) -> None:
        super().__init__()
        self._priorities = priorities
        self._waiting: list[tuple[Any, Any, Any]] = []
        self._looking: Iterator[tuple[Any, Any, Any]] | None = None
        priorities.at_end.append(self._forget)

    def add_node(self, node: Any) -> bool:
        """Add a node; its timers say what the thread's priority is to begin with."""
        added: bool = super().add_node(node)
        for timer in node.timers:
            self._priorities.raise_to(self._priorities.urgency(timer, node))
        return added

    def _spin_once_impl(
        self, timeout_sec: Any = None, wait_condition: Callable[[], bool] = lambda: False
    ) -> None:
        under_way = self._look(timeout_sec, wait_condition)
        if under_way is not None:
            self._run(under_way)
            return
        if not self._waiting:
            return
        urgencies = [self._priorities.urgency(entity, node) for _, entity, node in self._waiting]
        task, entity, node = self._waiting.pop(urgencies.index(min(urgencies)))
        self._priorities.raise_to(min(urgencies))
        self._priorities.runs(entity, node)
        with self._tasks_lock:
            self._tasks.append((task, entity, node))
        self._run(task)

    def _look(self, timeout_sec: Any, condition: Callable[[], bool]) -> Any:
        """Add what is ready to what waits, or return a task that is under way."""
        while True:
            if self._looking is None:
                timeout = 0 if self._waiting else timeout_sec
                self._looking = self._wait_for_ready_callbacks(timeout, None, condition)
            with self._tasks_lock:
                under_way = {id(task) for task, _, _ in self._tasks}
            try:
                task, entity, node = next(self._looking)
            except (StopIteration, TimeoutException, ConditionReachedException, ShutdownException):
                self._looking = None
                return None
            if entity is None or id(task) in under_way:  # made by create_task
                return task
            with self._tasks_lock:  # what only waits is none of rclpy's tasks yet
                self._tasks = [one for one in self._tasks if one[0] is not task]
            self._waiting.append((task, entity, node))

    def _forget(self) -> None:
        """Let go of what was ready at the end; Python warns of coroutines that never ran."""
        for task, _, _ in self._waiting:
            close = getattr(task._handler, "close", None)
            if close is not None:
                close()
        self._waiting = []

    def _run(self, task: Any) -> None:
        task()
        if task.exception() is not None:
            raise task.exception()
        task.result()
