"""The messages of one or two recordings that a filter or a search means, as far as is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rsltrace_viewer.model.recordings.filter import Condition, Mask, steps_of
from rsltrace_viewer.model.recordings.recording import Recording, Topic

Side = tuple[Recording, Topic | None]
Key = tuple[str, str]
"""A topic by its name and type."""


class Matches:
    """Looks at a topic when it is asked to, and remembers what it found."""

    def __init__(self, condition: Condition) -> None:
        self._condition = condition
        self._masks: dict[Key, list[Mask]] = {}

    def look(self, key: Key, sides: Sequence[Side]) -> Iterator[int]:
        """Look at a topic in each recording; yields how many messages were looked at by now.

        Raises BagError, TraceError.
        """
        if key in self._masks:
            return
        masks = []
        looked = 0
        for recording, topic in sides:
            found: list[Mask] = [np.zeros(0, dtype=np.bool_)]
            if topic is not None:
                for mask in steps_of(self._condition, recording, topic):
                    found.append(mask)
                    looked += len(mask)
                    yield looked
            masks.append(np.concatenate(found))
        self._masks[key] = masks

    def masks(self, key: Key) -> list[Mask] | None:
        """Return which messages of a topic are meant, for each recording; None if not yet known."""
        return self._masks.get(key)

    def counts(self, key: Key) -> list[int]:
        """Return how many these are; none where nothing is known."""
        return [int(mask.sum()) for mask in self._masks.get(key, [])]
