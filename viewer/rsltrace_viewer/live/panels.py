"""What a live screen has besides: the breakpoints."""

from __future__ import annotations

from collections.abc import Sequence

from textual.content import Content
from textual.widgets import Static

from rsltrace.debug.positions import Breakpoint
from rsltrace.trace.model.printable import printable

_SHOWN_MAX = 4


class BreakpointsPanel(Static):
    """The breakpoints, and which of them has stopped the run."""

    DEFAULT_CSS = """
    BreakpointsPanel { height: auto; background: $surface; border-top: solid $panel; padding: 0 1;
                  border-title-color: $text-muted; }
    """

    def show(self, found: Sequence[Breakpoint], hit: int | None) -> None:
        """Show breakpoints; ``hit`` is the number of the one at which the run stands."""
        self.border_title = "breakpoints"
        if not found:
            self.update(Content.styled("none: B sets one, as in /odom: twist.x > 3", "$text-muted"))
            return
        first = max(len(found) - _SHOWN_MAX, 0)
        lines = []
        for one in found[first:]:
            sign = "▶" if one.number == hit else "●"
            style = "bold $text-error" if one.number == hit else ""
            lines.append(Content.styled(printable(f"{sign} {one.number}  {one.text}"), style))
        if first:
            lines[0] = Content.styled(f"… {first + 1} more", "$text-muted")
        self.update(Content("\n").join(lines))
