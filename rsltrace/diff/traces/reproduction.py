"""Which of two runs that diverge a third one repeats, told at the event where they diverge."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rsltrace.diff.alignment.first_difference import first_difference
from rsltrace.trace.native import refuse_native
from rsltrace.trace.reader import Trace


class Repeats(Enum):
    """What a third run did where two diverge."""

    A = "a"
    B = "b"
    NEITHER = "a third result"
    TOO_SHORT = "too short"


@dataclass(frozen=True, slots=True)
class Reproduction:
    """The answer, and the sentence that says it."""

    repeats: Repeats
    sentence: str

    @property
    def exit_code(self) -> int:
        """0 if one of the runs was repeated, 1 if not."""
        return 0 if self.repeats in (Repeats.A, Repeats.B) else 1


def reproduction(a: Trace, b: Trace, again: Trace) -> Reproduction:
    """Say which of two runs ``again`` repeats up to and including the event where they diverge.

    What comes after that is not looked at: ``again`` may have been recorded with ``--until``.

    :raises TraceError: if one of them is of a native run, which repeats nothing.
    """
    for trace in (a, b, again):
        refuse_native(trace, "it repeats no other run")
    place = first_difference(a, b)
    if place is None:
        same = first_difference(a, again) is None
        sentence = f"a and b are the same run, and {again.name} {'too' if same else 'another one'}"
        return Reproduction(Repeats.A if same else Repeats.NEITHER, sentence)
    from_a, from_b = first_difference(a, again), first_difference(b, again)
    third = f"the third run ({again.name})"
    where = f"at event {place}, where a and b diverge"
    if from_a is None or from_a > place:
        return Reproduction(Repeats.A, f"{third} reproduces a: it does the same {where}")
    if from_b is None or from_b > place:
        return Reproduction(Repeats.B, f"{third} reproduces b: it does the same {where}")
    ended = again.ended_after if again.ended_after is not None else again.event_count
    if from_a == from_b and ended <= from_a:
        sentence = f"{third} ends before event {place}, where a and b diverge: record more"
        return Reproduction(Repeats.TOO_SHORT, sentence)
    sentence = (
        f"{third} is a third result: it differs from a at event {from_a} and from b at event "
        f"{from_b}; a and b diverge at event {place}"
    )
    return Reproduction(Repeats.NEITHER, sentence)
