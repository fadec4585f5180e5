"""What widgets that draw their own lines need of Textual beyond its usual ways."""

from __future__ import annotations

from rich.style import Style
from textual.geometry import Size
from textual.scroll_view import ScrollView
from textual.widget import Widget


def background_of(style: Style) -> Style:
    """Return what of ``style`` lies over others: its background and weight, not its colour."""
    return Style(bgcolor=style.bgcolor, bold=style.bold)


def set_virtual_size(view: ScrollView, size: Size) -> None:
    """Say how much there is to scroll through.

    Setting the attribute would lay out and draw the whole screen again, for every event one steps
    to; with a scrollbar that is always there, nothing else on the screen can change.
    """
    if view.virtual_size != size:
        view.set_reactive(Widget.virtual_size, size)
        view._scroll_update(size)
