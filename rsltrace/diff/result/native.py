"""What a diff says of two runs of which one, or both, are native: content, order and timing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rsltrace.diff.result.bags import BagDiff, MessageDivergence
from rsltrace.trace.native import Spread

if TYPE_CHECKING:
    from rsltrace.words.entities import EntityKey


@dataclass(frozen=True, slots=True)
class CallbackTimes:
    """When the callbacks of one entity ran, in both runs.

    ``measure`` says of what ``a`` and ``b`` are the spread: ``period``, from one call of a timer to
    the next, or ``latency``, from the start of the callback that caused it.
    """

    entity: EntityKey
    events_a: int
    events_b: int
    measure: str
    a: Spread | None
    b: Spread | None


@dataclass(frozen=True, slots=True)
class NativeComparison:
    """``native`` are the sides that are: ``("a",)``. ``content`` compares the messages, topic by
    topic; ``tails`` are topics of which one run has more messages, at its end.

    Of ``compared`` callbacks that both have, ``moved`` ran in another order; ``first_moved`` is the
    first of them.
    """

    native: tuple[str, ...]
    content: BagDiff
    differs: bool
    """Whether a message says something else, or is missing before the end; not whether messages
    changed places."""
    first: MessageDivergence | None
    """The first that does, on a topic that both have."""
    tails: tuple[str, ...]
    compared: int
    moved: int
    first_moved: str
    callbacks: tuple[CallbackTimes, ...]
