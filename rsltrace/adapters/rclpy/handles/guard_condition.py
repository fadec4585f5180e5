"""The handle of ``rclpy.GuardCondition``."""

from __future__ import annotations

from rsltrace.adapters.rclpy.handles.entity_handle import Alarm, EntityHandle
from rsltrace.adapters.rclpy.stacks.runners import Stacks
from rsltrace.adapters.rclpy.stacks.tasks import is_awaited, start_callback
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind, OutputKind

_GUARD = int(EventKind.GUARD_CONDITION)


class GuardConditionHandle(EntityHandle):
    """Stands in for ``_rclpy.GuardCondition``.

    A trigger that comes before the last one was handled is merged with it. Executors make guard
    conditions, too, to wake themselves; no node lists those and nothing comes of their triggers.
    ``alarms`` hear of every trigger.
    """

    kind = EntityKind.GUARD_CONDITION
    lists = "guards"

    def __init__(self, stacks: Stacks) -> None:
        self.stacks = stacks
        super().__init__(stacks.dispatcher, None)
        self._triggered = False
        self._cause = (0, 0)
        self._found: tuple[int, int] | None = None
        self.alarms: tuple[Alarm, ...] = ()

    def trigger_guard_condition(self) -> None:
        """Make the callback ready."""
        if not self._triggered:
            self._triggered = True
            if self.active:
                loop, dispatcher = self.dispatcher.loop, self.dispatcher
                self._cause = (loop.events, dispatcher.note(OutputKind.GUARD, self.entity_id))
                loop.ready.append(self)
        for alarm in self.alarms:
            alarm()

    def found(self) -> None:
        """A polling point has found it: another trigger from now on is for the next one."""
        if self._triggered:
            self._found, self._triggered = self._cause, False

    @property
    def is_due(self) -> bool:
        """Whether its callback has to run."""
        return self._triggered or self._found is not None

    def is_triggered(self) -> bool:
        """Return whether a trigger has not been handled yet."""
        return self._triggered

    def take_trigger(self) -> None:
        """Handle the triggers until now, as a wait set does that has found them."""
        self._triggered = False

    def activate(self) -> None:
        if self._triggered:
            self._cause = (self.dispatcher.loop.events, 0)
            self.dispatcher.loop.ready.append(self)

    def dispatch(self) -> None:
        """Run the callback once for all triggers until now."""
        if self.mailbox_keeps():
            return
        wrapper = self.wrapper
        if not self.is_due or wrapper is None or self.destroyed:
            return
        if self.stacks.groups.must_wait(self, wrapper):
            return
        cause = self._found
        if cause is None:
            cause, self._triggered = self._cause, False
        self._found = None
        callback = wrapper.callback
        if is_awaited(self.stacks, callback):
            start_callback(self.stacks, self, _GUARD, callback, (), *cause, 0)
        else:
            self.dispatcher.execute(
                self, self.entity_id, self.node, _GUARD, callback, (), *cause, 0
            )
