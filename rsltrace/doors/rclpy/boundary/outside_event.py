"""Events that are no entity's callback: construction, shutdown, a clock jump, a main, a thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.entry import Entry


class OutsideEvent:
    """Stands where an entity's handle does. ``entry`` is what is being constructed, or None."""

    def __init__(self, describe: Callable[[], str], entry: Entry | None) -> None:
        self.describe = describe
        self.entry = entry

    def dispatch(self) -> None:
        """Fail: the loop never has it in a queue."""
        raise AssertionError("never in a queue")
