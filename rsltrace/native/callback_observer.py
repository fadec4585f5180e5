"""Where a callback begins and ends: what rclpy's executors make of what is ready."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any

import rclpy.executors
from rclpy.executors import (
    ConditionReachedException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)

from rsltrace.native.message_observer import MessageObserver
from rsltrace.native.observed_entities import ObservedEntities, ObservedEntity
from rsltrace.native.priorities import Priorities
from rsltrace.native.span_recorder import (
    CallbackError,
    CallbackSpan,
    ReceivedInput,
    SpanRecorder,
    TaskCreation,
)
from rsltrace.native.support import patched
from rsltrace.simulation.middleware.events.failure import exception_text, user_traceback
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


def make_executor(name: str, priorities: Priorities | None) -> Any:
    """Return an executor: rclpy's of a name, or one that goes by priorities."""
    if priorities is not None:
        return PriorityExecutor(priorities)
    return getattr(rclpy.executors, name)()


EXECUTORS = {"single": "SingleThreadedExecutor", "multi": "MultiThreadedExecutor"}
_KINDS = {
    EntityKind.TIMER: EventKind.TIMER,
    EntityKind.SUBSCRIPTION: EventKind.SUBSCRIPTION,
    EntityKind.SERVICE: EventKind.SERVICE,
    EntityKind.CLIENT: EventKind.CLIENT,
    EntityKind.QOS_EVENT: EventKind.QOS_EVENT,
}


class CallbackObserver:
    """Tells a recorder of the callbacks that any executor of this process runs."""

    def __init__(
        self,
        recorder: SpanRecorder,
        entities: ObservedEntities,
        messages: MessageObserver,
        meet: Callable[[Any, Any], object],
    ) -> None:
        """``meet`` is told, before it is taken from, of a node and of what it has."""
        self._meet = meet
        self._recorder = recorder
        self._entities = entities
        self._messages = messages
        self._own = threading.local()

    @contextmanager
    def watched(self, *, threads_are_processes: bool = True) -> Iterator[None]:
        """Observe all callbacks meanwhile. A thread that stands for a process has a global
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
        self._messages.take()
        call: Callable[[], Any] | None = take(entity)
        taken = self._messages.take()
        if call is None:
            return None
        observed = taken.entity if taken is not None else self._observed_entity(entity)
        if observed is None:
            return None  # nothing was there after all
        kind = self._kind(entity, observed)
        return partial(ObservedTask, self._recorder, kind, observed, call, taken)

    def _observed_entity(self, entity: Any) -> ObservedEntity | None:
        from rclpy.client import Client
        from rclpy.event_handler import EventHandler
        from rclpy.service import Service
        from rclpy.subscription import Subscription

        if isinstance(entity, (Subscription, Client, Service)):
            return None
        kind = EntityKind.GUARD_CONDITION
        if isinstance(entity, EventHandler):
            kind = EntityKind.QOS_EVENT
        return self._entities.unnamed(entity, kind)

    def _kind(self, entity: Any, observed: ObservedEntity) -> int:
        from rclpy.action.client import ActionClient
        from rclpy.action.server import ActionServer

        if isinstance(entity, (ActionServer, ActionClient)):
            return int(EventKind.ACTION)
        return int(_KINDS.get(observed.kind, EventKind.GUARD_CONDITION))

    def _create_task(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def create_task(executor: Any, callback: Any, *args: Any, **kwargs: Any) -> Any:
            under_way = self._recorder.current()
            if under_way is None or _is_own(callback):
                return original(executor, callback, *args, **kwargs)
            recorder, observed, cause = (
                self._recorder,
                under_way.entity,
                self._recorder.add(TaskCreation()),
            )
            if inspect.iscoroutine(callback) or inspect.iscoroutinefunction(callback):
                call = partial(_awaited, callback, args, kwargs)
                return original(executor, partial(_run_async, recorder, observed, call, cause))
            call = partial(callback, *args, **kwargs)
            return original(executor, partial(_run, recorder, observed, call, cause))

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
    recorder: SpanRecorder,
    observed: ObservedEntity | None,
    call: Callable[[], Any],
    cause: tuple[CallbackSpan, int],
) -> Any:
    """Run a task that is a plain function."""
    recorder.interrupts.hold()
    recorder.begin(int(EventKind.TASK), observed, None, cause)
    failure = None
    try:
        recorder.interrupts.release()
        return call()
    except BaseException as error:
        failure = failure_of(error)
        raise
    finally:
        recorder.end(failure)


async def _run_async(
    recorder: SpanRecorder,
    observed: ObservedEntity | None,
    call: Callable[[], Any],
    cause: tuple[CallbackSpan, int],
) -> Any:
    return await ObservedTask(recorder, int(EventKind.TASK), observed, call, None, cause)


class ObservedTask:
    """Awaits ``call()``, and tells a recorder when it runs and when it waits."""

    def __init__(
        self,
        recorder: SpanRecorder,
        kind: int,
        observed: ObservedEntity | None,
        call: Callable[[], Any],
        taken: ReceivedInput | None,
        cause: tuple[CallbackSpan, int] | None = None,
    ) -> None:
        self._recorder = recorder
        self._begin = partial(recorder.begin, kind, observed, taken, cause)
        self._call = call

    def __await__(self) -> Generator[Any, Any, Any]:
        recorder = self._recorder
        steps = self._call().__await__()
        recorder.interrupts.hold()  # until what has begun is sure to end
        callback = self._begin()
        while True:
            try:
                recorder.interrupts.release()
                step = next(steps)
            except StopIteration as end:
                recorder.end()
                return end.value
            except BaseException as error:
                recorder.end(failure_of(error))
                steps.close()  # Python warns of one that has not begun
                raise
            recorder.suspend()
            try:
                yield step
            except BaseException:
                steps.close()
                raise
            recorder.resume(callback)


def failure_of(error: BaseException) -> CallbackError:
    """Return what a trace keeps of an exception."""
    return CallbackError(type(error).__qualname__, exception_text(error), user_traceback(error))
