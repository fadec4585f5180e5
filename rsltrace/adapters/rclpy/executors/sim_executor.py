"""The executor of a job's own nodes: rclpy's Executor API on top of the event loop."""

from __future__ import annotations

import sys
from typing import Any

from rclpy.executors import Executor

from rsltrace.adapters.rclpy.concurrency.blocking_calls import EventSetter, SimEvent, wait
from rsltrace.adapters.rclpy.concurrency.coroutines import ResumeTask
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.concurrency.tasks import create_task
from rsltrace.adapters.rclpy.executors.user_executors import is_bookkeeping
from rsltrace.adapters.rclpy.handles.wait_set import activate_node, deactivate_node, sync_woken
from rsltrace.trace.model.texts import waiting_ns


class SimExecutor(Executor):  # type: ignore[misc]
    """The executor of a run. The callbacks of the nodes added to it run."""

    def __init__(self, runtime: Runtime, context: Any) -> None:
        self._runtime = runtime
        self._sim_nodes: dict[Any, None] = {}
        super().__init__(context=context)

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """Run a callback or coroutine right after the current event."""
        if type(callback) in (ResumeTask, EventSetter) or is_bookkeeping(callback):
            callback(*args)  # rclpy's own, not an event
            return None
        return create_task(self._runtime, callback, args, kwargs)

    def add_node(self, node: Any) -> bool:
        if node in self._sim_nodes:
            return False
        handle = node.handle  # which a node that is not constructed yet does not have
        self._sim_nodes[node] = None
        node.executor = self
        mailbox, handle.mailbox = handle.mailbox, None
        handle.wrapper = node
        activate_node(handle)
        if mailbox is not None:
            self._runtime.loop.ready.extend(item for _, item in mailbox.entries)
        return True

    def remove_node(self, node: Any) -> None:
        if self._sim_nodes.pop(node, self) is None:
            deactivate_node(node.handle)

    def get_nodes(self) -> list[Any]:
        return list(self._sim_nodes)

    def wake(self) -> None:
        """Look for added and removed waitables; the loop sees all other changes at once."""
        sync_woken(self._sim_nodes, sys._getframe(1))

    def spin_until_future_complete(self, future: Any, timeout_sec: float | None = None) -> None:
        """Wait in simulated time until the future is done."""
        if future.done() or future.cancelled():
            return
        done = SimEvent(self._runtime, "a future to be completed")
        future.add_done_callback(EventSetter(done))
        done.wait(None if timeout_sec is None or timeout_sec < 0 else timeout_sec)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Let everything that is ready run, else wait for the next event within the timeout."""
        runtime = self._runtime
        loop = runtime.loop
        if loop.tasks or loop.ready:
            wait(runtime, "its turn", for_ns=0)
            return
        next_ns = loop.next_ns()
        limit_ns = None
        if timeout_sec is not None and timeout_sec >= 0:
            limit_ns = waiting_ns(timeout_sec)
        if next_ns is not None:
            ahead_ns = max(next_ns - loop.now_ns, 0)
            limit_ns = ahead_ns if limit_ns is None else min(limit_ns, ahead_ns)
        wait(runtime, "anything to happen", for_ns=limit_ns)

    def spin_once_until_future_complete(self, future: Any, timeout_sec: Any = None) -> None:
        """Wait as ``spin_once`` does, unless the future is done."""
        if not future.done():
            self.spin_once(getattr(timeout_sec, "timeout", timeout_sec))

    def spin(self) -> None:
        while self._context.ok():
            wait(self._runtime, "the run to end", patient=True)
