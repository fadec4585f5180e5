"""The handle of ``rclpy.GuardCondition``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rsltrace.doors.rclpy.boundary.callback_groups import begin, must_wait
from rsltrace.doors.rclpy.boundary.entity_handle import EntityHandle
from rsltrace.doors.rclpy.stacks.tasks import is_coroutine_function, start_coroutine
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import EventKind, OutputKind

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core

_GUARD = int(EventKind.GUARD_CONDITION)


class GuardConditionHandle(EntityHandle):
    """Stands in for ``_rclpy.GuardCondition``.

    A trigger that comes before the last one was handled is merged with it. Executors make guard
    conditions, too, to wake themselves; no node lists those and nothing comes of their triggers.
    """

    kind = EntityKind.GUARD_CONDITION
    lists = "guards"

    def __init__(self, core: Core) -> None:
        super().__init__(core, None)
        self._triggered = False
        self._cause = (0, 0)

    def trigger_guard_condition(self) -> None:
        """Make the callback ready."""
        if self._triggered:
            return
        self._triggered = True
        core = self.core
        if self.wrapper is not None:
            self._cause = (core.loop.events, core.note(OutputKind.GUARD, self.entity_id))
            core.loop.ready.append(self)

    def is_triggered(self) -> bool:
        """Return whether a trigger has not been handled yet."""
        return self._triggered

    def take_trigger(self) -> None:
        """Handle the triggers until now, as a wait set does that has found them."""
        self._triggered = False

    def activate(self) -> None:
        if self._triggered:
            self._cause = (self.core.loop.events, 0)
            self.core.loop.ready.append(self)

    def dispatch(self) -> None:
        """Run the callback once for all triggers until now."""
        mailbox = self.node.mailbox if self.node is not None else None
        if mailbox is not None and mailbox.keeps(self):
            return
        wrapper = self.wrapper
        if not self._triggered or wrapper is None or self.destroyed:
            return
        core = self.core
        if must_wait(core, self, wrapper):
            return
        self._triggered = False
        callback = wrapper.callback
        if is_coroutine_function(callback):
            begin(wrapper.callback_group, wrapper)
            start_coroutine(core, self, _GUARD, callback, (), *self._cause, 0)
        else:
            core.execute(self, self.entity_id, self.node, _GUARD, callback, (), *self._cause, 0)
