"""Where one has been, to go back and forward through, and the events one marked.

Events, not places: these change as two runs are aligned, and with which run is shown.
"""

from __future__ import annotations

from collections.abc import Iterable

Event = tuple[bool, int]
"""An event: whether it is of run b, and its index."""

_KEPT = 500


class History:
    """Events visited. Going somewhere new after going back drops what lay ahead, as in browsers."""

    def __init__(self) -> None:
        self._back: list[Event] = []
        self._ahead: list[Event] = []

    def leave(self, event: Event) -> None:
        """Remember ``event`` before jumping away from it."""
        if not self._back or self._back[-1] != event:
            self._back.append(event)
            del self._back[:-_KEPT]
        self._ahead.clear()

    def back(self, event: Event) -> Event | None:
        """Return where to go back to from ``event``; None at the beginning."""
        while self._back and self._back[-1] == event:
            self._back.pop()
        if not self._back:
            return None
        self._ahead.append(event)
        return self._back.pop()

    def forward(self, event: Event) -> Event | None:
        """Return where one came back from; None if there is nothing ahead."""
        if not self._ahead:
            return None
        self._back.append(event)
        return self._ahead.pop()


class Marks:
    """Marked events. A row of two runs is marked with all events in it."""

    def __init__(self) -> None:
        self.events: set[Event] = set()

    def of(self, row: Iterable[Event]) -> bool:
        """Return whether an event of a row is marked."""
        return bool(self.events) and not self.events.isdisjoint(row)

    def toggle(self, row: Iterable[Event]) -> bool:
        """Set or remove the mark of a row; return whether it is set now."""
        row = set(row)
        if self.of(row):
            self.events -= row
            return False
        self.events |= row
        return True
