"""What an audit has found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rsltrace.guard.rules import Treatment

SAFE_TREATMENTS = frozenset({Treatment.VIRTUAL, Treatment.PINNED})
"""With these, a second run does the same."""


@dataclass(frozen=True, slots=True, order=True)
class AuditFinding:
    """One call in a source file; lines and columns count from 1, as in editors."""

    path: Path
    line: int
    column: int
    kind: str
    call: str
    treatment: Treatment
    does: str
    instead: str


@dataclass(frozen=True, slots=True)
class AuditReport:
    """The result of an audit. ``troubles`` names files that are not readable as Python, ``allowed``
    counts findings that a comment silences."""

    found: tuple[AuditFinding, ...]
    files: int
    troubles: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    allowed: int = 0
