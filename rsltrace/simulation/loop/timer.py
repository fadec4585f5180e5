"""A timer's deadlines, with the arithmetic of rcl.

Source of the rules: ``rcl/src/rcl/timer.c`` of rcl 9.2 (ROS 2 Jazzy). Deadlines stay on the grid
the timer was started on; periods that were missed are skipped, not made up for.
"""

from __future__ import annotations


class TimerState:
    """Period and deadline of one timer, in nanoseconds of simulated time.

    ``order`` is the creation order, the tie-breaker of equal deadlines. ``owner`` is what the loop
    dispatches when the timer is due. ``ticket`` belongs to the timer queue.
    """

    __slots__ = ("canceled", "deadline_ns", "last_call_ns", "order", "owner", "period_ns", "ticket")

    def __init__(
        self, period_ns: int, now_ns: int, *, order: int, owner: object, canceled: bool = False
    ) -> None:
        if period_ns < 0:
            raise ValueError(f"timer period must not be negative, is {period_ns} ns")
        self.period_ns = period_ns
        self.last_call_ns = now_ns
        self.deadline_ns = now_ns + period_ns
        self.canceled = canceled
        self.order = order
        self.owner = owner
        self.ticket: object = None

    def call(self, now_ns: int) -> None:
        """Account for a call at ``now_ns``: move the deadline to its next grid point."""
        self.last_call_ns = now_ns
        deadline_ns = self.deadline_ns + self.period_ns
        if deadline_ns <= now_ns:
            if self.period_ns == 0:
                deadline_ns = now_ns
            else:
                deadline_ns += (1 + (now_ns - deadline_ns) // self.period_ns) * self.period_ns
        self.deadline_ns = deadline_ns

    def reset(self, now_ns: int) -> None:
        """Start a new grid at ``now_ns``; a cancelled timer runs again."""
        self.deadline_ns = now_ns + self.period_ns
        self.canceled = False
