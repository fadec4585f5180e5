"""rclpy's executors on simulated time.

All executors ask ``wait_for_ready_callbacks`` for the next callback. It is answered from the
mailboxes of the executor's nodes; if they are empty, the call blocks in simulated time. Everything
else (``spin``, ``spin_once``, worker threads, exceptions) is rclpy's own code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rsltrace.adapters.rclpy.concurrency.blocking_calls import (
    POLL_NS,
    count_refused_wait,
    suspended_event,
    wait,
)
from rsltrace.adapters.rclpy.concurrency.callback_groups import begin, is_busy, is_custom
from rsltrace.adapters.rclpy.concurrency.mailbox import Mailbox, describe_awaited
from rsltrace.adapters.rclpy.concurrency.runtime import BlockedCall, Runtime
from rsltrace.adapters.rclpy.executors.standby import FinishedTask, Standby, standby_of
from rsltrace.adapters.rclpy.handles.wait_set import activate_node
from rsltrace.simulation.loop.loop import Dispatchable
from rsltrace.simulation.loop.ordered import OrderedLoop
from rsltrace.simulation.middleware.graph import Graph

_WORK = "work for its executor"


class ExecutorDriver:
    """Feeds one executor of user code with the callbacks that are ready."""

    def __init__(self, runtime: Runtime, executor: Any) -> None:
        from rclpy import executors
        from rclpy.utilities import timeout_sec_to_nsec

        self.runtime = runtime
        self.executor = executor
        self._rclpy: Any = executors
        self._in_ns: Any = timeout_sec_to_nsec
        self.nodes: dict[Any, Mailbox] = {}
        self.tasks = Mailbox(runtime.loop)
        self.tasks.driver = self
        self.waits: list[BlockedCall] = []
        self.standby: Standby | None = None
        """The stack that spins, while it can be given what is ready."""
        self.woken = False
        """Whether there was a reason to look again."""
        self._looked_ns = -1
        self._name = f"executor {runtime.loop.next_place()}"
        self._asked: tuple[Any, ...] = ()

    def add(self, node: Any) -> None:
        """Run a node's callbacks whenever the executor spins."""
        handle = node.handle
        if handle.mailbox is None:
            handle.mailbox = Mailbox(self.runtime.loop)
        handle.mailbox.driver = self
        self.nodes[node] = handle.mailbox
        if handle.wrapper is not node:
            handle.wrapper = node
            activate_node(handle)
        self.wake()

    def remove(self, node: Any) -> None:
        """Stop running a node's callbacks; ready ones stay in its mailbox."""
        mailbox = self.nodes.pop(node, None)
        if mailbox is not None and mailbox.driver is self:
            mailbox.driver = None
        self.wake()

    def close(self) -> None:
        """Give up all nodes: the executor is shut down."""
        for node in list(self.nodes):
            self.remove(node)
        self.tasks.close()
        self.wake()

    def wake(self) -> None:
        """Let every waiting spin look again."""
        self.woken = True
        standby, self.standby = self.standby, None
        if standby is not None:
            standby.blocked.release()
        waits, self.waits = self.waits, []
        for blocked in waits:
            blocked.release()

    def next(
        self, timeout: Any, nodes: list[Any] | None, condition: Callable[[], bool]
    ) -> tuple[Any, Any, Any]:
        """Implement ``wait_for_ready_callbacks``: return a task that runs the next callback.

        :raises: rclpy's exceptions for a timeout, a shutdown, or a condition that is met.
        """
        executors = self._rclpy
        self.runtime.programs.present.spun = True
        timeout_ns: int = self._in_ns(getattr(timeout, "timeout", timeout))
        loop = self.runtime.loop
        until_ns = None if timeout_ns < 0 else loop.now_ns + timeout_ns
        looked = False
        if isinstance(loop, OrderedLoop) and loop.polls:
            asked, self._asked = self._asked, (timeout, nodes, condition)
            if asked != self._asked:  # rclpy makes a new generator
                loop.forget(self._name)
        while True:
            if self.executor._is_shutdown:
                raise executors.ShutdownException
            if condition():
                raise executors.ConditionReachedException
            if not self.executor.context.ok():
                if self.runtime.ending.closing:
                    count_refused_wait(self.runtime)
                raise executors.ExternalShutdownException
            taken = self._take(nodes)
            if taken is not None:
                return self._handler(*taken)
            has_limit = until_ns is not None
            standby = standby_of(self.runtime, self, nodes, condition, has_limit=has_limit)
            if until_ns is None:
                patient = _is_always(condition) and not self.runtime.dispatcher.in_callback()
                graph = self.runtime.domain.graph
                what = _WORK if _is_always(condition) else _AwaitedFuture(graph, condition)
                self._wait(None, what=what, patient=patient, standby=standby)
            elif loop.now_ns < until_ns:
                self._wait(until_ns - loop.now_ns, what=_WORK, standby=standby)
            elif timeout_ns or looked:
                raise executors.TimeoutException
            else:
                looked = True
                self._wait(self._look_ns(), what="its turn", standby=standby)
            if standby is not None and standby.is_over:
                return FinishedTask(standby.failure), None, None

    def _look_ns(self) -> int:
        """Return how long a poll takes: 0 for the first one at an instant."""
        now_ns = self.runtime.loop.now_ns
        again, self._looked_ns = self._looked_ns == now_ns, now_ns
        return POLL_NS if again else 0

    def _wait(
        self,
        for_ns: int | None,
        *,
        what: object,
        patient: bool = False,
        standby: Standby | None = None,
    ) -> None:
        self.woken = True
        until = self.waits.append if standby is None else standby.begin
        serve = None if standby is None else standby.serve
        runtime = self.runtime
        wait(runtime, what, until=until, for_ns=for_ns, quiet=True, patient=patient, serve=serve)
        if standby is not None and self.standby is standby:
            self.standby = None
        self.waits = [blocked for blocked in self.waits if blocked in self.runtime.runners.blocked]

    def _take(self, nodes: list[Any] | None) -> tuple[Any, Mailbox, Dispatchable] | None:
        """Take the next item: tasks first, as in rclpy, then in order of arrival; or the policy's
        choice, if the policy polls."""
        if isinstance(self.runtime.loop, OrderedLoop) and self.runtime.loop.polls:
            return self._choose(self.runtime.loop, nodes)
        if self.tasks.entries:
            return None, self.tasks, self.tasks.entries.popleft()[1]
        while True:
            best: tuple[int, Any, Mailbox] | None = None
            for node, mailbox in self.nodes.items():
                if mailbox.entries and (nodes is None or node in nodes):
                    first = mailbox.entries[0][0]
                    if best is None or first < best[0]:
                        best = (first, node, mailbox)
            if best is None:
                return None
            _, node, mailbox = best
            place, item = mailbox.entries.popleft()
            if not _is_stale(item) and not self._parked(mailbox, place, item):
                return node, mailbox, item

    def _choose(
        self, loop: OrderedLoop, nodes: list[Any] | None
    ) -> tuple[Any, Mailbox, Dispatchable] | None:
        """Take the item that the policy chooses among all that are ready."""
        loop.hand_over()
        ready = [(None, self.tasks, entry) for entry in self.tasks.entries]
        for node, mailbox in self.nodes.items():
            if nodes is None or node in nodes:
                ready += [(node, mailbox, entry) for entry in mailbox.entries]
        ready.sort(key=lambda one: (one[1] is not self.tasks, one[2][0]))
        free = []
        for node, mailbox, (place, item) in ready:
            gone = _is_stale(item) or not getattr(item, "is_due", True)
            if gone or self._parked(mailbox, place, item):
                mailbox.entries.remove((place, item))
            else:
                free.append((node, mailbox, (place, item)))
        if not free:
            return None
        candidates = [loop.place(item).candidate for _, _, (_, item) in free]
        chosen = loop.choose([replace(one, executor=self._name) for one in candidates])
        node, mailbox, entry = free[chosen]
        mailbox.entries.remove(entry)
        return node, mailbox, entry[1]

    def _parked(self, mailbox: Mailbox, place: int, item: Any) -> bool:
        """Park an item whose callback group is busy until the group is free."""
        wrapper = getattr(item, "wrapper", None)
        group = getattr(wrapper, "callback_group", None)
        if group is None or not is_busy(group, wrapper):
            return False

        def retry() -> None:
            mailbox.entries.appendleft((place, item))
            if mailbox.driver is not None:
                mailbox.driver.wake()

        self.runtime.groups.park(group, item, retry)
        return True

    def _handler(self, node: Any, mailbox: Mailbox, item: Any) -> tuple[Any, Any, Any]:
        task = self._rclpy.Task(self._run, (mailbox, item), executor=self.executor)
        return task, getattr(item, "wrapper", None), node

    def _run(self, mailbox: Mailbox, item: Dispatchable) -> None:
        """Run one callback as an event, on the spinning stack."""
        runtime = self.runtime
        runtime.event.took_ns = 0
        with suspended_event(runtime):
            mailbox.run(item)
        failure, mailbox.raised = mailbox.raised, None
        if runtime.event.took_ns:
            self._be_busy(item, runtime.event.took_ns)
        if failure is not None:
            raise failure

    def _be_busy(self, item: Any, for_ns: int) -> None:
        """Let the callback's execution time pass, with its stack and group busy."""
        wrapper = getattr(item, "wrapper", None)
        group = getattr(wrapper, "callback_group", None)
        held = group is not None and not is_custom(group) and not is_busy(group, wrapper)
        if held:
            begin(group, wrapper)
        try:
            wait(self.runtime, "a callback to be over", for_ns=for_ns, quiet=True)
        finally:
            if held:
                self.runtime.groups.end(group, wrapper)


class _AwaitedFuture:
    """Describes the future that a spin waits for."""

    def __init__(self, graph: Graph, condition: Callable[[], bool]) -> None:
        self._graph = graph
        self._future = getattr(condition, "__self__", None)

    def __str__(self) -> str:
        return f"a future to be completed: {describe_awaited(self._graph, self._future)}"


def _is_stale(item: Any) -> bool:
    """Return whether an item was destroyed, or its message dropped from a full queue."""
    return getattr(item, "destroyed", False) or not getattr(item, "queue", True)


def _is_always(condition: Callable[[], bool]) -> bool:
    """Return whether a condition is rclpy's default, which is never met."""
    return getattr(condition, "__name__", "") == "<lambda>"


def driver_of(runtime: Runtime, executor: Any) -> ExecutorDriver:
    driver: ExecutorDriver | None = executor.__dict__.get("_rsltrace_driver")
    if driver is None or driver.runtime is not runtime:
        driver = executor.__dict__["_rsltrace_driver"] = ExecutorDriver(runtime, executor)
    return driver
