"""What full queues dropped in a run: as a trace keeps it, and as a run tells it."""

from __future__ import annotations

from collections.abc import Mapping

from rsltrace.simulation.middleware.entity import Receiver
from rsltrace.trace.model.drop import Drop

_TOLD = 5

Counts = Mapping[tuple[Receiver, int], int]
"""How many, by receiver, and by how many messages a publisher holds in an outage if its queue was
the full one (else 0)."""


def drops(counts: Counts) -> list[Drop]:
    """Return what full queues dropped, in the order of the entities."""
    found = [
        Drop(receiver.entity_id, held or receiver.keep or 0, count, in_outage=held > 0)
        for (receiver, held), count in counts.items()
    ]
    return sorted(found, key=lambda one: (one.entity, one.in_outage))


def drop_notes(counts: Counts) -> list[str]:
    """Name the queues that dropped most, in one note."""
    most = sorted(counts.items(), key=lambda item: (-item[1], item[0][0].entity_id))
    if not most:
        return []
    parts = [
        f"{receiver.describe()} {count} (depth {held or receiver.keep}"
        f"{', of a publisher in an outage' if held else ''})"
        for (receiver, held), count in most[:_TOLD]
    ]
    if len(most) > _TOLD:
        parts.append(f"{len(most) - _TOLD} more (rsltrace info lists them)")
    return [f"full queues dropped their oldest messages: {'; '.join(parts)}"]
