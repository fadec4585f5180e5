"""Where one has been, to go back and forward through, and the places one marked."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort

_KEPT = 500


class History:
    """Places visited. Going somewhere new after going back drops what lay ahead, as in browsers."""

    def __init__(self) -> None:
        self._back: list[int] = []
        self._ahead: list[int] = []

    def leave(self, place: int) -> None:
        """Remember ``place`` before jumping away from it."""
        if not self._back or self._back[-1] != place:
            self._back.append(place)
            del self._back[:-_KEPT]
        self._ahead.clear()

    def back(self, place: int) -> int | None:
        """Return where to go back to from ``place``; None at the beginning."""
        while self._back and self._back[-1] == place:
            self._back.pop()
        if not self._back:
            return None
        self._ahead.append(place)
        return self._back.pop()

    def forward(self, place: int) -> int | None:
        """Return where one came back from; None if there is nothing ahead."""
        if not self._ahead:
            return None
        self._back.append(place)
        return self._ahead.pop()


class Marks:
    """Marked places, in order."""

    def __init__(self) -> None:
        self._places: list[int] = []

    def __contains__(self, place: int) -> bool:
        found = bisect_left(self._places, place)
        return found < len(self._places) and self._places[found] == place

    def __len__(self) -> int:
        return len(self._places)

    def toggle(self, place: int) -> bool:
        """Set or remove the mark at ``place``; return whether it is set now."""
        if place in self:
            self._places.remove(place)
            return False
        insort(self._places, place)
        return True

    def next(self, place: int, step: int) -> int | None:
        """Return the mark after (``step`` 1) or before (-1) ``place``; None if there is none."""
        found = bisect_right(self._places, place) if step > 0 else bisect_left(self._places, place)
        found = found if step > 0 else found - 1
        return self._places[found] if 0 <= found < len(self._places) else None
