"""How fast simulated time passes while somebody waits for what is outside: as fast as real time."""

from __future__ import annotations

import time

from rsltrace.guard.redirect import copy_of

STEP_NS = 1_000_000
_IN_A_ROW_MAX = 20
_LAG_NS_MAX = 100_000_000
"""A run that is slow catches up; but one that computed for minutes has not waited for minutes."""

_real_ns = copy_of(time.monotonic_ns)  # type: ignore[arg-type]


class RealTimePace:
    """Tells how far simulated time has got ahead of real time since somebody began to wait."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self.in_a_row = 0
        """How many waits in a row ended at once, because the answer was there already."""

    def is_greedy(self) -> bool:
        """Count one more such answer; return whether it is time to let others go on."""
        self.in_a_row += 1
        if self.in_a_row < _IN_A_ROW_MAX:
            return False
        self.in_a_row = 0
        return True

    def ahead_s(self, now_ns: int) -> float:
        """Return how many seconds to wait for real before simulated time may go on."""
        real_ns: int = _real_ns()
        if self._offset_ns is None:
            self._offset_ns = now_ns - real_ns
        ahead_ns = now_ns - real_ns - self._offset_ns
        if ahead_ns > STEP_NS:  # others have made time pass meanwhile
            ahead_ns = STEP_NS
        elif ahead_ns < -_LAG_NS_MAX:
            ahead_ns = -_LAG_NS_MAX
        self._offset_ns = now_ns - real_ns - ahead_ns
        return max(ahead_ns, 0) / 1e9
