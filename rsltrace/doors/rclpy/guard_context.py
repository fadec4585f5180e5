"""What the guard asks of the simulated world: the time, the node, the event under way."""

from __future__ import annotations

from typing import TYPE_CHECKING

from greenlet import getcurrent

from rsltrace.doors.rclpy.stacks.blocking_calls import wait
from rsltrace.model.finding import Policy

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core


class GuardContext:
    """Answers for one world."""

    def __init__(self, core: Core) -> None:
        self._core = core

    def now_ns(self) -> int:
        """Return simulated time."""
        core = self._core
        if core.clocks is None or core.current_node is None:
            return core.loop.now_ns
        return core.clocks.shows(core.current_node.fully_qualified_name, core.loop.now_ns)

    def node(self) -> str:
        """Return the node whose code runs, or the entry whose constructor has made none yet."""
        core = self._core
        if core.current_node is not None:
            return core.current_node.fully_qualified_name
        entry = core.entry
        return entry.key if entry is not None else ""

    def policy(self) -> Policy | None:
        """Return the policy of that node."""
        return self._core.policy

    def place(self) -> tuple[int, int]:
        """Return the index of the event under way and the entity that runs."""
        core = self._core
        return core.loop.events, core.current_entity

    def pass_time(self, for_ns: int) -> None:
        """Let time pass for a callback that does nothing but look at the clock."""
        core = self._core
        if core.current_handle is not None and not core.ending:
            wait(core, "time to pass (it reads a clock again and again)", for_ns=for_ns)

    def is_aside(self) -> bool:
        """Return whether a thread or a main waits, not a callback: others can go on meanwhile."""
        core = self._core
        if not self.can_step() or core.in_callback():
            return False
        stack = getcurrent()
        return core.is_thread(stack) or core.program_of(stack) is not None

    def can_step(self) -> bool:
        """Return whether whoever runs can wait in simulated time at all."""
        return self._core.current_handle is not None and not self._core.ending

    def step(self, for_ns: int) -> None:
        """Let simulated time pass, and others go on."""
        wait(self._core, "something outside of the run", for_ns=for_ns, quiet=True)
