"""What an output is, in a few words, as far as its record tells: without its payload."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby

from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.words.kinds import kind_label

_NAMELESS = frozenset((OutputKind.LOG, OutputKind.EXCEPTION, OutputKind.SHUTDOWN))
"""Kinds of which one says what, not of whom: the event's node."""


def output_text(kind: int, name: str, entity_kind: str) -> str:
    """Return ``/odom``, ``call /plan``, ``reply /plan``, ``new publisher /map``, ``log``, …

    ``name`` and ``entity_kind`` are those of the entity that the output belongs to.
    """
    if kind == OutputKind.MESSAGE:
        return name
    if kind == OutputKind.REQUEST:
        return f"call {name}"
    if kind == OutputKind.RESPONSE:
        return f"reply {name}"
    if kind == OutputKind.ENTITY:
        return f"new {entity_kind} {name}".rstrip()
    if kind in _NAMELESS:
        return kind_label(OutputKind, kind)
    return f"{kind_label(OutputKind, kind)} {name}".rstrip()


def counted(texts: Iterable[str]) -> Iterator[str]:
    """Yield texts; of equal ones next to each other, one and how many: ``/odom ×3``."""
    for text, same in groupby(texts):
        count = sum(1 for _ in same)
        yield text if count == 1 else f"{text} ×{count}"
