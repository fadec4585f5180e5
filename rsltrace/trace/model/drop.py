"""What full queues dropped in a run, as a trace keeps it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass

_KEPT = 10_000


@dataclass(frozen=True, slots=True)
class Drop:
    """How many arrivals a queue of ``depth`` dropped because it was full: that of the receiver with
    an id in the trace or, ``in_outage``, that of a publisher which could not reach it."""

    entity: int
    depth: int
    count: int
    in_outage: bool = False


def kept_drops(drops: Iterable[Drop]) -> dict[str, str]:
    """Return what the result of a run says of its drops."""
    kept = [astuple(one) for one in drops][:_KEPT]
    return {"drops": json.dumps(kept)} if kept else {}


def drops_of(result: Mapping[str, str]) -> list[Drop]:
    """Return the drops of a result; none if they were not written by us."""
    try:
        return [
            Drop(int(entity), int(depth), int(count), bool(in_outage))
            for entity, depth, count, in_outage in json.loads(result.get("drops", "[]"))
        ]
    except (ValueError, TypeError):
        return []
