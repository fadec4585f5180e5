"""The entries of a job, each in a thread of its own: constructed, spun, and stopped."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rsltrace.adapters.rclpy.entry import JobEntry
from rsltrace.errors import JobError
from rsltrace.native.callback_observer import failure_of
from rsltrace.native.node_observer import NodeObserver
from rsltrace.native.observed_entities import ObservedEntities
from rsltrace.native.span_recorder import SpanRecorder
from rsltrace.trace.model.event import EventKind


class RunningEntry(threading.Thread):
    """Constructs one entry's nodes, and spins them once ``start`` is set.

    ``on_end`` is called when it is over, with what it raised.
    """

    def __init__(
        self,
        entry: JobEntry,
        recorder: SpanRecorder,
        nodes: NodeObserver,
        make_executor: Callable[[], Any],
        start: threading.Event,
        on_end: Callable[[RunningEntry, BaseException | None], None],
    ) -> None:
        super().__init__(name=f"rsltrace {entry.name}", daemon=True)
        self.entry = entry
        self.nodes: list[Any] = []
        self.constructed = threading.Event()
        self.stopping = False
        self._recorder = recorder
        self._nodes = nodes
        self._make_executor = make_executor
        self._begin = start
        self._on_end = on_end
        self._executor: Any = None

    def run(self) -> None:
        error: BaseException | None = None
        try:
            self._construct()
            self._begin.wait()
            self._spin()
        except BaseException as raised:
            error = raised
        self._on_end(self, error)
        self.constructed.set()

    def stop(self) -> None:
        """Let it end after the callback that it is in."""
        from rclpy.executors import Executor

        self.stopping = True
        self._begin.set()
        executor = self._executor
        if executor is not None:
            with suppress(Exception):  # rclpy is shut down already
                Executor.create_task(executor, _nothing)

    @property
    def node_name(self) -> str:
        """The full name of its first node, empty if it has none."""
        return str(self.nodes[0].get_fully_qualified_name()) if self.nodes else ""

    @property
    def failed_in(self) -> str:
        """What went wrong if it raised, in words."""
        return f"{'a callback of' if self.nodes else 'constructing'} {self.entry.name}"

    @property
    def busy(self) -> int | None:
        """The thread in which a callback runs: its own, or one of a multi-threaded executor."""
        if self.is_alive():
            return self.ident
        pool = getattr(getattr(self._executor, "_executor", None), "_threads", ())
        running = self._recorder.stacks
        return next((one.ident for one in pool if running.get(one.ident)), None)

    def is_idle(self) -> bool:
        """Whether no callback of it runs any more."""
        return self.busy is None

    def _construct(self) -> None:
        recorder = self._recorder
        recorder.begin(int(EventKind.CONSTRUCT), None)
        failure = None
        try:
            with self._nodes.constructing(self.entry):
                made = self.entry.make()
            self.nodes = list(made) if isinstance(made, (list, tuple)) else [made]
            self._check()
        except BaseException as error:
            failure = failure_of(error)
            raise
        finally:
            recorder.end(failure)
        self.constructed.set()

    def _check(self) -> None:
        from rclpy.node import Node

        for node in self.nodes:
            if not isinstance(node, Node):
                raise JobError(
                    f"{self.entry.name} gave a {type(node).__qualname__}, not an rclpy Node: name "
                    "a Node subclass or a function that returns a node (or a list of nodes)"
                )

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        self._executor = executor = self._make_executor()
        for node in self.nodes:
            executor.add_node(node)
        while not self.stopping and executor.context.ok() and not self.entry.is_component:
            try:
                executor.spin_once()
            except ExternalShutdownException:
                return
            except Exception as error:
                if not self.entry.log_exceptions:
                    raise
                self.nodes[0].get_logger().error(f"{type(error).__qualname__}: {error}")


def destroy(nodes: list[Any], recorder: SpanRecorder, entities: ObservedEntities) -> None:
    """Destroy nodes in the order of their construction, each as one event."""
    for node in nodes:
        recorder.begin(int(EventKind.SHUTDOWN), entities.find(node))
        failure = None
        try:
            node.destroy_node()
        except Exception as error:
            failure = failure_of(error)
        finally:
            recorder.end(failure)


def _nothing() -> None:
    """Wake an executor that waits."""
