"""Lines of the inspector: a tree written as lines with depths, opened where one wants to look.

What is open is remembered by path (``in.pose.pose``), not by event, so stepping through a topic
keeps showing the field one cares about.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum


class Role(Enum):
    """What a line is, for its colour."""

    SECTION = "section"
    FIELD = "field"
    BYTES = "bytes"
    NOTE = "note"
    LINK = "link"
    ERROR = "error"
    WARNING = "warning"
    DIFFERENCE = "difference"
    SAME = "same"


@dataclass(frozen=True, slots=True)
class Line:
    """One line. ``path`` names it among all; ``open`` is None where there is nothing inside.

    ``link`` is the index of an event to go to; ``other_run`` says that it is one of run b.
    """

    depth: int
    label: str
    value: str
    role: Role
    path: str
    open: bool | None = None
    link: int | None = None
    other_run: bool = False


@dataclass
class Openness:
    """Which paths are open. Everything starts as its builder says; toggling turns that around."""

    toggled: set[str] = field(default_factory=set)

    def is_open(self, path: str, default: bool) -> bool:
        """Whether ``path`` is open."""
        return default != (path in self.toggled)

    def toggle(self, path: str) -> None:
        """Open or close ``path``."""
        self.toggled ^= {path}
