"""Two runs next to each other: placeholder until the engine is there."""

from __future__ import annotations

from rsltrace_viewer.model.lines import Line, Openness


class Comparison:
    """Two runs."""

    def lines(self, place: int, openness: Openness) -> list[Line]:
        """Return lines."""
        return []

    identical = True

    def verdict(self) -> str:
        """Return a sentence."""
        return ""

    def divergence_in(self, window: object) -> int | None:
        """Return where."""
        return None

    def next_divergence(self, place: int, step: int) -> int | None:
        """Return where."""
        return None
