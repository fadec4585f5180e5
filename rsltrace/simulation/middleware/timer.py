"""Timers: rcl's arithmetic on simulated time."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from rsltrace.simulation.loop.timer_queue import TimerState
from rsltrace.simulation.middleware.entity import DomainEntity, callback_name
from rsltrace.simulation.middleware.events.dispatcher import Dispatcher
from rsltrace.trace.chain import hash64
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import NO_EVENT, EventKind, OutputKind
from rsltrace.trace.model.operation import TIMER_CANCEL, TIMER_PERIOD, TIMER_RESET

TIMER = int(EventKind.TIMER)
_pack_deadline = struct.Struct("<Q").pack


class Timer(DomainEntity):
    """Calls ``callback()`` every ``period_ns`` of simulated time."""

    kind = EntityKind.TIMER

    def __init__(
        self,
        dispatcher: Dispatcher,
        node: Any,
        period_ns: int,
        callback: Callable[[], object] | None = None,
        *,
        canceled: bool = False,
    ) -> None:
        super().__init__(dispatcher, node)
        self.callback = callback
        self._autostart = not canceled
        now_ns = dispatcher.loop.now_ns
        self.state = TimerState(
            period_ns, now_ns, order=self.entity_id, owner=self, canceled=canceled
        )
        self.activate()

    def activate(self) -> None:
        if self.active and not self.state.canceled and not self.destroyed:
            self.dispatcher.loop.timers.add(self.state)

    def dispatch(self) -> None:
        """Run the callback of a due timer, and set its next deadline."""
        callback = self.callback
        assert callback is not None
        digest = self.deadline_hash()
        dispatcher, state = self.dispatcher, self.state
        state.call(dispatcher.loop.now_ns)
        dispatcher.loop.timers.ran(state)
        dispatcher.execute(
            self, self.entity_id, self.node, TIMER, callback, (), NO_EVENT, 0, digest
        )

    def deadline_hash(self) -> int:
        """Return the input hash of a timer's event: its deadline."""
        if self.dispatcher.recorder is None:
            return 0
        return hash64(_pack_deadline(self.state.deadline_ns))

    def cancel(self) -> None:
        """Stop; ``reset`` starts again."""
        self.state.canceled = True
        self.dispatcher.loop.timers.remove(self.state)
        self._note(TIMER_CANCEL, 0)

    def reset(self) -> None:
        self.state.reset(self.dispatcher.loop.now_ns)
        if self.active:
            self.dispatcher.loop.timers.add(self.state)
        self._note(TIMER_RESET, self.state.deadline_ns)

    def set_period(self, period_ns: int) -> None:
        """Set the period; the present deadline stays."""
        if period_ns != self.state.period_ns:
            self.state.period_ns = period_ns
            self._note(TIMER_PERIOD, period_ns)

    def _note(self, operation: int, value: int) -> None:
        if self.active:
            self.dispatcher.note(OutputKind.TIMER, self.entity_id, operation, value)

    def period(self) -> int | None:
        return self.state.period_ns

    def trace_name(self) -> str:
        return callback_name(self.user_callback())

    def trace_detail(self) -> dict[str, object]:
        began = {} if self._autostart else {"autostart": False}
        return {"period_ns": self.state.period_ns, **began}

    def _destroy(self) -> None:
        super()._destroy()
        self.dispatcher.loop.timers.remove(self.state)
