"""Gives the guard the simulated time, the running node and the current event."""

from __future__ import annotations

from greenlet import getcurrent

from rsltrace.adapters.rclpy.concurrency.blocking_calls import wait
from rsltrace.adapters.rclpy.concurrency.entry_starts import entry_of, policy_of
from rsltrace.adapters.rclpy.concurrency.runtime import Runtime
from rsltrace.adapters.rclpy.node_clocks import NodeClocks
from rsltrace.trace.model.finding import GuardPolicy


class GuardContext:
    """The guard's view of one world."""

    def __init__(self, runtime: Runtime, clocks: NodeClocks | None) -> None:
        self._runtime = runtime
        self._clocks = clocks
        self.direct = (runtime.loop, runtime.event) if clocks is None else None

    def look(self) -> tuple[int, str, int]:
        """Return the index of the current event, the node and simulated time."""
        return self._runtime.loop.events, self.node(), self.now_ns()

    def now_ns(self) -> int:
        """Return simulated time."""
        node, now_ns = self._runtime.event.node, self._runtime.loop.now_ns
        if self._clocks is None or node is None:
            return now_ns
        return self._clocks.shows(node.fully_qualified_name, now_ns)

    def node(self) -> str:
        """Return the running node, or the entry whose constructor has made none yet."""
        runtime = self._runtime
        if runtime.event.node is not None:
            return str(runtime.event.node.key)
        entry = entry_of(runtime.event)
        return entry.key if entry is not None else ""

    def process(self) -> int:
        """Return the number of the running main, from 1; 0 for the job's own nodes."""
        programs = self._runtime.programs
        return 0 if programs.is_hosted else programs.all.index(programs.present) + 1

    def policy(self) -> GuardPolicy | None:
        return policy_of(self._runtime.event)

    def place(self) -> tuple[int, int]:
        """Return the index of the current event and the running entity."""
        runtime = self._runtime
        return runtime.loop.events, runtime.event.entity

    def pass_time(self, for_ns: int) -> None:
        """Let time pass for a callback that reads the clock in a loop."""
        runtime = self._runtime
        if runtime.event.handle is not None and not runtime.ending.unwinding:
            wait(runtime, "time to pass (it reads a clock again and again)", for_ns=for_ns)

    def is_aside(self) -> bool:
        """Return whether a thread or a main runs, not a callback: others can go on meanwhile."""
        runtime = self._runtime
        if not self.can_step() or runtime.dispatcher.in_callback():
            return False
        stack = getcurrent()
        return runtime.threads.runs_on(stack) or runtime.programs.on_stack(stack) is not None

    def can_step(self) -> bool:
        """Return whether the running code can wait in simulated time."""
        return self._runtime.event.handle is not None and not self._runtime.ending.unwinding

    def step(self, for_ns: int) -> None:
        """Wait in simulated time."""
        wait(self._runtime, "something outside of the run", for_ns=for_ns, quiet=True)
