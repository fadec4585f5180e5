"""What an audit finds: the place, the call, what the guard does about it, what to write instead."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from rsltrace.trace.model.finding import Mode, Policy, Source


class Treatment(str, Enum):
    """What becomes of a call in a recorded run.

    ``virtual``: the run answers it; ``pinned``: ``rsltrace record`` fixes what it depends on;
    ``recorded``, ``detected``, ``refused``: the job keeps the answer in the trace, reports the call
    or ends with it; ``nothing``: it goes past the guard, or the job allows it.
    """

    VIRTUAL = "virtual"
    PINNED = "pinned"
    RECORDED = "recorded"
    DETECTED = "detected"
    REFUSED = "refused"
    NOTHING = "nothing"


IS_SAFE = frozenset({Treatment.VIRTUAL, Treatment.PINNED})
"""With these, a run does the same again."""

_OF_MODE = {
    Mode.VIRTUAL: Treatment.VIRTUAL,
    Mode.RECORD: Treatment.RECORDED,
    Mode.WARN: Treatment.DETECTED,
    Mode.ERROR: Treatment.REFUSED,
    Mode.ALLOW: Treatment.NOTHING,
}


@dataclass(frozen=True, slots=True)
class Rule:
    """One kind of call. ``does`` says what the guard does where ``treatment`` applies."""

    kind: str
    treatment: Treatment
    does: str
    instead: str
    source: Source | None = None
    """The key of ``guard:`` that governs it, if any does."""
    is_class: bool = False
    """Naming it is harmless; calling it or deriving from it is not."""

    def treated(self, policy: Policy | None, whose: str = "the job") -> tuple[Treatment, str]:
        """Return what a guard with this policy (None: no guard at all) does about the call."""
        if policy is None:
            return Treatment.NOTHING, "the job has no guard"
        if self.source is None or self.treatment not in (Treatment.VIRTUAL, Treatment.DETECTED):
            return self.treatment, self.does
        mode = policy.modes[self.source]
        if self.treatment is Treatment.DETECTED and mode is Mode.VIRTUAL:
            mode = Mode.WARN
        treatment = _OF_MODE[mode]
        if treatment is self.treatment:
            return treatment, self.does
        return treatment, f"{whose} says {self.source.value}: {mode.value}"


@dataclass(frozen=True, slots=True, order=True)
class Found:
    """One place in a source file; lines and columns count from 1, as editors do."""

    path: Path
    line: int
    column: int
    kind: str
    call: str
    treatment: Treatment
    does: str
    instead: str


@dataclass(frozen=True, slots=True)
class Audit:
    """All that was found, and what could not be looked at."""

    found: tuple[Found, ...]
    files: int
    troubles: tuple[str, ...] = ()
    """Files that cannot be read as Python: nothing is known of them."""
    notes: tuple[str, ...] = ()
    allowed: int = 0
    """Places that a comment silences."""
