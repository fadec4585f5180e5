"""The guard's call counts, as in the metadata ``rsltrace:guard``."""

from __future__ import annotations

import json
from collections.abc import Iterable

from rsltrace.errors import TraceError
from rsltrace.trace.model.finding import GuardCount, GuardMode, NondeterminismSource


def counts_text(counts: Iterable[GuardCount]) -> str:
    """Return the counts as sorted JSON."""
    rows = [[c.source.value, c.mode.value, c.node, c.call, c.count] for c in counts]
    return json.dumps(sorted(rows), ensure_ascii=False)


def parse_counts(text: str) -> tuple[GuardCount, ...]:
    """Return the counts of ``counts_text``. Raises TraceError for anything else."""
    try:
        return tuple(
            GuardCount(
                NondeterminismSource(source), GuardMode(mode), str(node), str(call), int(count)
            )
            for source, mode, node, call, count in json.loads(text)
        )
    except (ValueError, TypeError, RecursionError) as error:
        raise TraceError(f"the guard's summary in the trace cannot be read: {error}") from error
