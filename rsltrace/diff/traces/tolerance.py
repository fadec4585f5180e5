"""Whether two runs that diverge are equal within tolerance after all.

A tolerance at the first divergence says little: what follows from it may grow. So all messages of
both runs are compared, which takes reading all of both; that is done only if tolerances are given
and the runs otherwise did the same things at the same times.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.result import BagDiff
from rsltrace.trace.model.event import NO_SEQUENCE, OutputKind
from rsltrace.trace.reader import Trace

_SAME_EVENTS = "stamp entity kind flags outputs cause_event cause_output".split()
_SAME_OUTPUTS = "event entity kind".split()
_WITH_MESSAGE = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE, OutputKind.LOG)
_ENDED_ALIKE = ("stop_reason", "exit_code", "end_time")
_AT_ONCE = 4096


def messages_within(a: Trace, b: Trace, start: int, options: DiffOptions) -> BagDiff | None:
    """Compare all messages of two runs that diverge at event ``start``.

    Return None if no tolerance is given, or if more than the contents of messages differs:
    events, their order and times, outputs that are no messages or were not recorded.
    """
    if not (options.tolerant or options.ignore) or not _alike_but_for_messages(a, b, start):
        return None
    from rsltrace.diff.bags.comparison import (
        compare_messages,  # what recordings need, and most diffs do not
    )

    return compare_messages(a, b, options)


def _alike_but_for_messages(a: Trace, b: Trace, start: int) -> bool:
    if a.event_count != b.event_count or a.output_count != b.output_count:
        return False
    if any(a.result.get(key) != b.result.get(key) for key in _ENDED_ALIKE):
        return False
    if not (a.complete and b.complete) or a.entities != b.entities:
        return False
    for first in range(start, a.event_count, _AT_ONCE):
        last = first + _AT_ONCE
        events_a, events_b = (_joined(list(trace.events(first, last))) for trace in (a, b))
        if not all(np.array_equal(events_a[name], events_b[name]) for name in _SAME_EVENTS):
            return False
        outputs_a, outputs_b = (_joined(list(trace.outputs(first, last))) for trace in (a, b))
        if not all(np.array_equal(outputs_a[name], outputs_b[name]) for name in _SAME_OUTPUTS):
            return False
        other = outputs_a["hash"] != outputs_b["hash"]
        kept = np.isin(outputs_a["kind"], [int(kind) for kind in _WITH_MESSAGE])
        kept &= (outputs_a["sequence"] != NO_SEQUENCE) & (outputs_b["sequence"] != NO_SEQUENCE)
        if (other & ~kept).any():
            return False
    return True


def _joined(parts: list[npt.NDArray[np.void]]) -> npt.NDArray[np.void]:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
