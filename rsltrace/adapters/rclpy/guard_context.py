"""Gives the guard the simulated time, the running node and the current event."""

from __future__ import annotations

from greenlet import getcurrent

from rsltrace.adapters.rclpy.node_clocks import NodeClocks
from rsltrace.adapters.rclpy.stacks.blocking_calls import wait
from rsltrace.adapters.rclpy.stacks.entry_starts import entry_of, policy_of
from rsltrace.adapters.rclpy.stacks.runtime import Runtime
from rsltrace.trace.model.finding import GuardPolicy


class GuardContext:
    """The guard's view of one world."""

    def __init__(self, stacks: Runtime, clocks: NodeClocks | None) -> None:
        self._stacks = stacks
        self._clocks = clocks
        self.direct = (stacks.loop, stacks.event) if clocks is None else None

    def look(self) -> tuple[int, str, int]:
        """Return the index of the current event, the node and simulated time."""
        return self._stacks.loop.events, self.node(), self.now_ns()

    def now_ns(self) -> int:
        """Return simulated time."""
        node, now_ns = self._stacks.event.node, self._stacks.loop.now_ns
        if self._clocks is None or node is None:
            return now_ns
        return self._clocks.shows(node.fully_qualified_name, now_ns)

    def node(self) -> str:
        """Return the running node, or the entry whose constructor has made none yet."""
        stacks = self._stacks
        if stacks.event.node is not None:
            return str(stacks.event.node.key)
        entry = entry_of(stacks.event)
        return entry.key if entry is not None else ""

    def process(self) -> int:
        """Return the number of the running main, from 1; 0 for the job's own nodes."""
        programs = self._stacks.programs
        return 0 if programs.is_hosted else programs.all.index(programs.present) + 1

    def policy(self) -> GuardPolicy | None:
        return policy_of(self._stacks.event)

    def place(self) -> tuple[int, int]:
        """Return the index of the current event and the running entity."""
        stacks = self._stacks
        return stacks.loop.events, stacks.event.entity

    def pass_time(self, for_ns: int) -> None:
        """Let time pass for a callback that reads the clock in a loop."""
        stacks = self._stacks
        if stacks.event.handle is not None and not stacks.ending.unwinding:
            wait(stacks, "time to pass (it reads a clock again and again)", for_ns=for_ns)

    def is_aside(self) -> bool:
        """Return whether a thread or a main runs, not a callback: others can go on meanwhile."""
        stacks = self._stacks
        if not self.can_step() or stacks.dispatcher.in_callback():
            return False
        stack = getcurrent()
        return stacks.threads.runs_on(stack) or stacks.programs.on_stack(stack) is not None

    def can_step(self) -> bool:
        """Return whether the running code can wait in simulated time."""
        return self._stacks.event.handle is not None and not self._stacks.ending.unwinding

    def step(self, for_ns: int) -> None:
        """Wait in simulated time."""
        wait(self._stacks, "something outside of the run", for_ns=for_ns, quiet=True)
