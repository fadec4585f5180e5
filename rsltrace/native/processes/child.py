"""The process of one entry of a native run: ``main`` is what it runs.

It gets its order, says that it could begin, begins on command, and sends what it observes
until it gets the command to end, or ends by itself. It never outlives the run.
"""

from __future__ import annotations

import atexit
import builtins
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import wraps
from types import ModuleType
from typing import Any

from rsltrace.adapters.rclpy.boundary.installation import native_extension
from rsltrace.adapters.rclpy.callback_errors import exit_status
from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.errors import JobError, RsltraceError, SetupError
from rsltrace.native.callback_observer import failure_of, make_executor
from rsltrace.native.native_run import ENDS_WITHIN_S, rclpy_running
from rsltrace.native.observed_entities import ObservedEntity
from rsltrace.native.priorities import Priorities
from rsltrace.native.processes.observers import ProcessObservers, SpanSender
from rsltrace.native.processes.wire import EntryOrder, Link, LinkError
from rsltrace.native.running_entry import RunningEntry, destroy
from rsltrace.native.span_recorder import RunningCallback
from rsltrace.native.support import Patience
from rsltrace.run.plans.entries import node_entries
from rsltrace.run.process import search_path
from rsltrace.run.provenance import source_files
from rsltrace.simulation.middleware.events.failure import exception_text, user_traceback
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind

# A main, a script or a module as a process of its own has it, observed.


class RunningMain:
    """Runs the main of an entry. What it does between its callbacks is its own events."""

    def __init__(
        self,
        entry: JobEntry,
        observers: ProcessObservers,
        tell_now: Callable[[RunningCallback | None], object],
        *,
        echo: bool,
    ) -> None:
        """``tell_now`` tells the run what was observed: its end may be a crash."""
        self._entry = entry
        self._tell_now = tell_now
        self._observers = observers
        self._words = [word for part in entry.arguments[:1] for word in part.arguments]
        if not echo:
            self._words += ["--ros-args", "--disable-stdout-logs"]
        self._is_over = False

    def is_constructed(self) -> bool:
        """Return whether it has waited or spun for the first time, or has ended."""
        callback = self._observers.recorder.main
        return self._is_over or (callback is not None and callback.span is None)

    def run(self) -> None:
        """Run it to its end; what it raises comes out. SIGINT interrupts it from now on."""
        recorder, entities, entry = self._observers.recorder, self._observers.entities, self._entry
        callback = recorder.begin(int(EventKind.CONSTRUCT), None)
        entity = entities.add((), None, EntityKind.MAIN, entry.name, runs=entry.make)
        callback.entity = entity
        if callback.span is not None:
            callback.span.entity = entity
        recorder.main = callback
        self._become_main(entity)
        failure = None
        try:
            # Asyncio compares the handler with this one before it puts its own in place.
            interrupt = recorder.interrupts.handle
            signal.default_int_handler = interrupt  # type: ignore[assignment]
            signal.signal(signal.SIGINT, interrupt)
            status = entry.make()
            if status is not None:  # a console script is sys.exit(main())
                raise SystemExit(status)
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:
            failure = failure_of(error)
            raise
        finally:
            recorder.end(failure)
            self._is_over = True

    def _become_main(self, entity: ObservedEntity) -> None:
        """Have this process be what ``ros2 run`` would have started."""
        import rclpy.clock
        import rclpy.context
        import rclpy.node
        import rclpy.timer

        main = ModuleType("__main__")
        vars(main).update(__builtins__=builtins, __annotations__={})
        sys.modules["__main__"] = main
        sys.argv = list(self._entry.argv or [self._entry.name])
        self._observers.nodes.main = self._entry
        context: Any = rclpy.context.Context
        context.init = self._with_words(context.init)
        for owner, name in (
            (time, "sleep"),
            (rclpy.timer.Rate, "sleep"),
            (rclpy.clock.Clock, "sleep_until"),
        ):
            setattr(owner, name, self._pausing(getattr(owner, name), entity))
        for owner, name in (
            (context, "shutdown"),
            (context, "try_shutdown"),
            (rclpy.node.Node, "destroy_node"),
        ):
            setattr(owner, name, self._ending(getattr(owner, name)))

    def _with_words(self, original: Callable[..., None]) -> Callable[..., None]:
        """Add the ROS arguments of the entry to those of ``rclpy.init``."""

        @wraps(original)
        def init(context: Any, args: Any = None, **more: Any) -> None:
            given = sys.argv if args is None else args
            original(context, [*given, *self._words], **more)

        return init

    def _pausing(self, original: Callable[..., Any], entity: ObservedEntity) -> Callable[..., Any]:
        """Let an event of the main end where it sleeps."""

        @wraps(original)
        def sleep(*words: Any, **more: Any) -> Any:
            self._observers.recorder.pause(entity)
            return original(*words, **more)

        return sleep

    def _ending(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Have all told before what may crash."""

        @wraps(original)
        def end(*words: Any, **more: Any) -> Any:
            self._tell_now(self._observers.recorder.current())
            return original(*words, **more)

        return end


def main(number: int) -> None:
    """Do what the run orders on the socket of a number."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # until there is something to interrupt
    link = Link(socket.socket(fileno=number))
    try:
        frame = link.receive(trusted=True)
    except LinkError as error:
        said = f"the job cannot be read in a process of its own ({error}): write functions and "
        link.send("error", "JobError", f"{said}classes in it as module:name")
        os._exit(2)
    if frame is None:
        os._exit(1)
    order: EntryOrder = frame[0]
    sys.path += [path for path in order.module_path if path not in sys.path]
    if order.command:
        _become(order, link)
    with ExitStack() as stack:
        status = _EntryProcess(order, link).run(stack)
        stack.pop_all()  # user code may run up to the end of the process
    sys.exit(status)


def _become(order: EntryOrder, link: Link) -> None:
    """Become another program; the kernel still ends it with the run."""
    link.send("ready", {})
    if link.receive() != ("go",):
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    link.close_on_exec()
    try:
        os.execvpe(order.command[0], order.command, order.environment or os.environ)
    except OSError as error:
        said = f"{order.command[0]} cannot be started: {error.strerror}"
        link.send("error", "JobError", said)
        os._exit(1)


class _EntryProcess:
    """One entry. The main thread runs it, another one listens to the run."""

    def __init__(self, order: EntryOrder, link: Link) -> None:
        self._order = order
        self._link = link
        self._observers = ProcessObservers(native_extension())
        self._sender: SpanSender | None = None
        self._entry: RunningEntry | None = None
        self._priorities: Priorities | None = None
        self._is_over = threading.Event()
        atexit.register(self._finish)  # runs last: what others register comes before
        os.register_at_fork(after_in_parent=self._forked, after_in_child=self._forget)

    def run(self, stack: ExitStack) -> int:
        """Run the entry; return the exit status of the process."""
        order = self._order
        try:
            stack.enter_context(search_path(order.job, native=True))
            entry = self._find(stack)
            if entry.argv is None:
                stack.enter_context(rclpy_running(echo=order.echo))
        except RsltraceError as error:
            self._link.send("error", type(error).__name__, str(error))
            return error.exit_code
        sources = {name: str(path) for name, path in source_files(order.job).items()}
        self._link.send("ready", sources)
        if self._link.receive() != ("go",):
            return 0
        if order.policy is not None and entry.argv is None:
            self._priorities = Priorities(self._observers.entities, order.rules)
            stack.enter_context(self._priorities.watched(native_extension()))
        self._observers.watch()
        return self._run_node(entry) if entry.argv is None else self._run_main(entry)

    def _find(self, stack: ExitStack) -> JobEntry:
        if self._order.plays_bags:
            from rsltrace.native.processes.bags import player

            return player(self._order.job, stack)
        (entry,) = node_entries(self._order.job, only={self._order.index})
        return entry

    def _begin(self, is_constructed: Any) -> None:
        self._sender = SpanSender(self._link, self._observers, is_constructed)
        self._sender.start()
        threading.Thread(target=self._listen, name="rsltrace listener", daemon=True).start()

    def _run_node(self, entry: JobEntry) -> int:
        observers, at_once = self._observers, threading.Event()
        at_once.set()
        self._entry = running = RunningEntry(
            entry, observers.recorder, observers.nodes, self._make_executor, at_once, self._ended
        )
        self._begin(running.constructed.is_set)
        running.run()  # in this thread
        return 0

    def _make_executor(self) -> Any:
        if self._priorities is not None and self._entry is not None:
            threading.current_thread().name = f"rsltrace {self._entry.entry.name}"
        return make_executor(self._order.executor, self._priorities)

    def _ended(self, one: RunningEntry, error: BaseException | None) -> None:
        if isinstance(error, JobError):
            self._link.send("error", type(error).__name__, str(error))
        elif error is not None:
            self._raised(one.failed_in, one.node_name, error)
        elif one.stopping:
            destroy(one.nodes, self._observers.recorder, self._observers.entities)
        elif not one.entry.is_component:  # its container has it
            self._link.send("shutdown")

    def _raised(self, what: str, node: str, error: BaseException) -> None:
        kind = type(error).__qualname__
        if isinstance(error, SetupError):  # interfaces that are not built
            self._link.send("error", kind, f"{what}: {error}")
            return
        self._link.send("raised", what, node, kind, exception_text(error), user_traceback(error))

    def _run_main(self, entry: JobEntry) -> int:
        running = RunningMain(entry, self._observers, self._tell_now, echo=self._order.echo)
        self._begin(running.is_constructed)
        try:
            running.run()
        except SystemExit as error:
            if error.code is not None and not isinstance(error.code, int):
                self._link.send("exit", exception_text(error))
            return exit_status(error)
        except KeyboardInterrupt:
            return 128 + signal.SIGINT
        except BaseException as error:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the answer to what is sent now
            self._raised(entry.name, "", error)
            return 1
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # what is left is still to be sent
        return 0

    def _listen(self) -> None:
        with suppress(OSError):
            if self._link.receive() is None:
                os._exit(1)
        if self._sender is not None:
            self._sender.tell_at_once()
        with suppress(OSError):
            self._link.send("stopping")
        if self._entry is not None:
            self._entry.stop()
        if not Patience(ENDS_WITHIN_S).wait(self._is_over.wait, self._is_over.is_set):
            from rsltrace.run.watchdog import place_of

            place = place_of(threading.main_thread().ident)
            self._finish()
            with suppress(OSError):
                self._link.send("stuck", place)
            os._exit(0)

    def _tell_now(self, under_way: RunningCallback | None) -> None:
        if self._sender is not None:  # this is no copy
            self._sender.tell_now(under_way)

    def _forked(self) -> None:
        with suppress(OSError):
            self._link.send("forked")

    def _forget(self) -> None:
        """Be a process that the run does not know: its connection is the parent's."""
        self._sender = self._priorities = None
        self._link.close()
        self._observers.forget()

    def _finish(self) -> None:
        self._is_over.set()
        if self._sender is not None:
            self._sender.finish()
        if self._priorities is not None:
            with suppress(OSError):
                self._link.send("levels", dict(self._priorities.levels))
        with suppress(OSError):
            self._link.send("end")


if __name__ == "__main__":
    main(int(sys.argv[1]))
