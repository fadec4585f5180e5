"""Where a callback begins and ends: what rclpy's executors make of what is ready."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any

from rclpy.executors import (
    ConditionReachedException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)

from rsltrace.native.boundary import Boundary
from rsltrace.native.ledger import Failed, Ledger, Scheduled, Span, Taken
from rsltrace.native.priorities import Priorities
from rsltrace.native.support import patched
from rsltrace.native.things import Thing, Things
from rsltrace.simulation.middleware.events.failure import text_of, user_traceback
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind

# rclpy's single-threaded executor, but that the most urgent of what is ready runs next.


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


EXECUTORS = {"single": "SingleThreadedExecutor", "multi": "MultiThreadedExecutor"}
_KINDS = {
    EntityKind.TIMER: EventKind.TIMER,
    EntityKind.SUBSCRIPTION: EventKind.SUBSCRIPTION,
    EntityKind.SERVICE: EventKind.SERVICE,
    EntityKind.CLIENT: EventKind.CLIENT,
    EntityKind.QOS_EVENT: EventKind.QOS_EVENT,
}


class Executors:
    """Tells a ledger of the callbacks that any executor of this process runs."""

    def __init__(
        self,
        ledger: Ledger,
        things: Things,
        boundary: Boundary,
        meet: Callable[[Any, Any], object],
    ) -> None:
        """``meet`` is told, before it is taken from, of a node and of what it has."""
        self._meet = meet
        self._ledger = ledger
        self._things = things
        self._boundary = boundary
        self._own = threading.local()

    @contextmanager
    def watched(self, *, threads_are_processes: bool = True) -> Iterator[None]:
        """Be told of all callbacks meanwhile. A thread that stands for a process has a global
        executor of its own."""
        import rclpy
        from rclpy.executors import Executor

        with ExitStack() as stack:
            stack.enter_context(patched(Executor, "_make_handler", self._make_handler))
            stack.enter_context(patched(Executor, "create_task", self._create_task))
            if threads_are_processes:
                stack.enter_context(patched(rclpy, "get_global_executor", self._global_executor))
            yield

    def _make_handler(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def make_handler(executor: Any, entity: Any, node: Any, take: Callable[..., Any]) -> Any:
            self._meet(node, entity)
            return original(executor, entity, node, partial(self._take, take))

        return make_handler

    def _take(self, take: Callable[..., Any], entity: Any) -> Callable[[], Any] | None:
        """Let an executor take what is ready; return what it is to await, told of in between."""
        self._boundary.take()
        call: Callable[[], Any] | None = take(entity)
        taken = self._boundary.take()
        if call is None:
            return None
        thing = taken.thing if taken is not None else self._thing(entity)
        if thing is None:
            return None  # nothing was there after all
        kind = self._kind(entity, thing)
        return partial(ObservedTask, self._ledger, kind, thing, call, taken)

    def _thing(self, entity: Any) -> Thing | None:
        from rclpy.client import Client
        from rclpy.event_handler import EventHandler
        from rclpy.service import Service
        from rclpy.subscription import Subscription

        if isinstance(entity, (Subscription, Client, Service)):
            return None
        kind = EntityKind.GUARD_CONDITION
        if isinstance(entity, EventHandler):
            kind = EntityKind.QOS_EVENT
        return self._things.unnamed(entity, kind)

    def _kind(self, entity: Any, thing: Thing) -> int:
        from rclpy.action.client import ActionClient
        from rclpy.action.server import ActionServer

        if isinstance(entity, (ActionServer, ActionClient)):
            return int(EventKind.ACTION)
        return int(_KINDS.get(thing.kind, EventKind.GUARD_CONDITION))

    def _create_task(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def create_task(executor: Any, callback: Any, *args: Any, **kwargs: Any) -> Any:
            under_way = self._ledger.current()
            if under_way is None or _is_own(callback):
                return original(executor, callback, *args, **kwargs)
            ledger, thing, cause = self._ledger, under_way.thing, self._ledger.add(Scheduled())
            if inspect.iscoroutine(callback) or inspect.iscoroutinefunction(callback):
                call = partial(_awaited, callback, args, kwargs)
                return original(executor, partial(_run_async, ledger, thing, call, cause))
            call = partial(callback, *args, **kwargs)
            return original(executor, partial(_run, ledger, thing, call, cause))

        return create_task

    def _global_executor(self, original: Callable[[], Any]) -> Callable[[], Any]:
        @wraps(original)
        def get_global_executor() -> Any:
            from rclpy.executors import SingleThreadedExecutor

            if not hasattr(self._own, "executor"):
                self._own.executor = SingleThreadedExecutor()
            return self._own.executor

        return get_global_executor


def _is_own(callback: Any) -> bool:
    """Whether a task is rclpy's (a future that wakes its executor), not the user's."""
    module = str(getattr(callback, "__module__", ""))
    return module.startswith("rclpy.") and module != "rclpy.action.server"  # runs users' goals


async def _awaited(callback: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return await (callback if inspect.iscoroutine(callback) else callback(*args, **kwargs))


def _run(
    ledger: Ledger, thing: Thing | None, call: Callable[[], Any], cause: tuple[Span, int]
) -> Any:
    """Run a task that is a plain function."""
    ledger.begin(int(EventKind.TASK), thing, None, cause)
    failure = None
    try:
        return call()
    except BaseException as error:
        failure = failure_of(error)
        raise
    finally:
        ledger.end(failure)


async def _run_async(
    ledger: Ledger, thing: Thing | None, call: Callable[[], Any], cause: tuple[Span, int]
) -> Any:
    return await ObservedTask(ledger, int(EventKind.TASK), thing, call, None, cause)


class ObservedTask:
    """Awaits ``call()``, and tells a ledger when it runs and when it waits."""

    def __init__(
        self,
        ledger: Ledger,
        kind: int,
        thing: Thing | None,
        call: Callable[[], Any],
        taken: Taken | None,
        cause: tuple[Span, int] | None = None,
    ) -> None:
        self._ledger = ledger
        self._begin = partial(ledger.begin, kind, thing, taken, cause)
        self._call = call

    def __await__(self) -> Generator[Any, Any, Any]:
        ledger = self._ledger
        steps = self._call().__await__()
        callback = self._begin()
        while True:
            try:
                step = next(steps)
            except StopIteration as end:
                ledger.end()
                return end.value
            except BaseException as error:
                ledger.end(failure_of(error))
                raise
            ledger.suspend()
            try:
                yield step
            except BaseException:
                steps.close()
                raise
            ledger.resume(callback)


def failure_of(error: BaseException) -> Failed:
    """Return what a trace keeps of an exception."""
    return Failed(type(error).__qualname__, text_of(error), user_traceback(error))
