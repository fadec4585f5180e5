"""Calls that waited until the end of a run, as a trace keeps them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from rsltrace.trace.model.printable import printable

_KEPT = 10
_HELD_KEPT = 1000


@dataclass(frozen=True, slots=True)
class EndlessWait:
    """A call that waited until the end of a run and that no time would have ended: since when (ns),
    who waited for what, and the ids of the entities it ``held`` back meanwhile."""

    since_ns: int
    text: str
    held: tuple[int, ...] = ()


def kept_waits(waits: Iterable[EndlessWait]) -> dict[str, str]:
    """Return what the result of a run says of its waits."""
    kept = [(one.since_ns, one.text, one.held[:_HELD_KEPT]) for one in waits][:_KEPT]
    return {"waits": json.dumps(kept)} if kept else {}


def waits_of(result: Mapping[str, str]) -> list[EndlessWait]:
    """Return the waits of a result, each in one line; none if they were not written by us."""
    try:
        return [
            EndlessWait(
                int(since), printable(" ".join(str(text).split())), tuple(int(one) for one in held)
            )
            for since, text, held in json.loads(result.get("waits", "[]"))
        ]
    except (ValueError, TypeError):
        return []
