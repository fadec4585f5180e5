"""What is ready to run of a node that an executor of the user's own runs.

The loop runs the nodes of a job itself. A node that user code has given to an executor of its own
(``rclpy.spin`` in a main, ``MultiThreadedExecutor``) runs only while that executor spins: the loop
hands what is ready over to the node's mailbox, and the executor takes it from there.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core
    from rsltrace.doors.rclpy.stacks.executor_pump import Pump
    from rsltrace.loop.loop import Dispatchable


class Mailbox:
    """What is ready and has not run yet, each with its place in the order of all arrivals."""

    def __init__(self, core: Core) -> None:
        self.core = core
        self.pump: Pump | None = None
        """The executor that has the node now."""
        self.closed = False
        """Whether the process the node lived in has ended: nothing of it runs any more."""
        self.entries: deque[tuple[int, Dispatchable]] = deque()
        self._admitted: Dispatchable | None = None

    def keeps(self, item: Dispatchable) -> bool:
        """Keep what the loop dispatches; False if the executor has taken it out and runs it."""
        if self._admitted is item:
            self._admitted = None
            return False
        if not self.closed:
            self.core.arrivals += 1
            self.entries.append((self.core.arrivals, item))
            if self.pump is not None:
                self.pump.wake()
        return True

    def run(self, item: Dispatchable) -> None:
        """Run what was taken out, on the stack of whoever calls this."""
        self._admitted = item
        item.dispatch()
        self._admitted = None

    def close(self) -> None:
        """Run nothing any more."""
        self.closed = True
        self.pump = None
        self.entries.clear()


def executor_of(core: Core, handle: Any) -> Any:
    """Return the executor that runs a handle's node: the user's own, or the run's."""
    mailbox: Mailbox | None = handle.node.mailbox if handle.node is not None else None
    if mailbox is not None and mailbox.pump is not None:
        return mailbox.pump.executor
    return core.executor
