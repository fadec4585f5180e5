"""The nodes of one process that crash or hang: what of them runs, and what keeps it from doing so.

Natively a process that is killed runs nothing any more, no ``finally`` either, so blocked calls are
left where they are. One that hangs is stopped between two instructions of its own: what is there
for it waits, its timers are late, and its calls return when it goes on.
"""

from __future__ import annotations

from typing import Any

from rsltrace.adapters.rclpy.entry import Entry
from rsltrace.adapters.rclpy.stacks.blocking_calls import abandon
from rsltrace.adapters.rclpy.stacks.mailbox import Mailbox, Spinner
from rsltrace.adapters.rclpy.stacks.program import Program
from rsltrace.adapters.rclpy.stacks.runners import Stacks, Wait


class Victims:
    """``nodes`` (handles) of one process: a ``program`` of its own, or the host of what an
    ``entry`` has made."""

    def __init__(
        self, stacks: Stacks, nodes: list[Any], program: Program, entry: Entry | None
    ) -> None:
        self._stacks = stacks
        self._nodes = nodes
        self._program = None if program is stacks.programs.host else program
        self._entry = entry
        self._running: list[Any] = []
        self._spinning: list[tuple[Mailbox, Spinner]] = []

    @property
    def are_gone(self) -> bool:
        """Whether they have crashed, or were destroyed."""
        return all(node.destroyed for node in self._nodes)

    def hold(self) -> None:
        """Let nothing of them run up to ``let_go``."""
        self._keep_what_comes()
        for node in self._nodes:
            if node.mailbox is not None:
                if node.mailbox.pump is not None:
                    self._spinning.append((node.mailbox, node.mailbox.pump))
                    node.mailbox.pump = None
            elif node.wrapper is not None:
                self._running.append(node.wrapper)
                self._stacks.executor.remove_node(node.wrapper)

    def let_go(self) -> None:
        """Let them go on: what has come meanwhile is ready now."""
        for node in self._running:
            if not node.handle.destroyed:
                self._stacks.executor.add_node(node)
        holders = self._nodes if self._program is None else [self._program, *self._nodes]
        for holder in holders:
            held, holder.held = holder.held, None
            self._stacks.loop.tasks.extend(held or ())
        for mailbox, pump in self._spinning:
            if not mailbox.closed:
                mailbox.pump = pump
                pump.wake()

    def vanish(self) -> None:
        """Take them out of the run for ever, as a process's death does."""
        self._keep_what_comes()
        stacks = self._stacks
        for blocked in [one for one in stacks.runners.blocked if self._is_ours(one)]:
            del stacks.runners.blocked[blocked]
            abandon(blocked.stack)
            blocked.stop_waiting()
        for run in [one for one in stacks.coroutines.suspended if one.node in self._nodes]:
            del stacks.coroutines.suspended[run]
        for thread in list(stacks.threads.alive):
            if thread.node in self._nodes or thread.program is self._program:
                thread.end()
        for node in self._nodes:
            if node.wrapper is not None and node.mailbox is None:
                stacks.executor.remove_node(node.wrapper)
            if node.mailbox is not None:
                node.mailbox.close()
            for endpoint in stacks.domain.graph.endpoints_of(node):
                endpoint.destroy()
            node.destroy()

    def _keep_what_comes(self) -> None:
        """Keep whatever of theirs the loop dispatches from now on."""
        if self._program is not None:
            self._program.held = []
        for node in self._nodes:
            node.held = []

    def _is_ours(self, blocked: Wait) -> bool:
        if self._program is not None:
            return blocked.program is self._program
        return blocked.event[2] in self._nodes or (
            self._entry is not None and blocked.constructing is self._entry
        )
