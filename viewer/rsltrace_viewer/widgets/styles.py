"""Rich styles made of Textual's, where a widget draws its own lines."""

from __future__ import annotations

from rich.style import Style


def background_of(style: Style) -> Style:
    """Return what of ``style`` lies over others: its background and weight, not its colour."""
    return Style(bgcolor=style.bgcolor, bold=style.bold)
