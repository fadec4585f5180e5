"""Messages that full queues dropped in a run, as a trace records them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass

_KEPT = 10_000


@dataclass(frozen=True, slots=True)
class QueueDrops:
    """How many messages a full queue of ``depth`` dropped: that of the receiving entity or,
    ``in_outage``, that of a publisher that could not reach it."""

    entity: int
    depth: int
    count: int
    in_outage: bool = False


def encode_drops(drops: Iterable[QueueDrops]) -> dict[str, str]:
    """Return the entry of a run's result for its drops."""
    kept = [astuple(one) for one in drops][:_KEPT]
    return {"drops": json.dumps(kept)} if kept else {}


def decode_drops(result: Mapping[str, str]) -> list[QueueDrops]:
    """Return the drops of a result; none if another program wrote them."""
    try:
        return [
            QueueDrops(int(entity), int(depth), int(count), bool(in_outage))
            for entity, depth, count, in_outage in json.loads(result.get("drops", "[]"))
        ]
    except (ValueError, TypeError):
        return []
