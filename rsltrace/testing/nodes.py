"""Asserting that a node, alone, still does what it did in a recording."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rsltrace.diff.options import DiffOptions
    from rsltrace.replay.one_node.result import NodeReplayResult

PathLike = str | os.PathLike[str]


class NodeChanged(AssertionError):
    """A node put out something else than was recorded; the message is the table of it."""


def assert_node_unchanged(
    trace: PathLike,
    node: str,
    *,
    bag: PathLike | Sequence[PathLike] | None = None,
    options: DiffOptions | None = None,
    job_folder: PathLike | None = None,
) -> NodeReplayResult:
    """Assert that a node of a trace, fed with what it got then, puts out what it put out then.

    ``bag`` feeds it from rosbag2 recordings; ``trace`` may be a job file, then. ``options`` leave
    fields out or tolerate differences. This runs the code that the trace names.

    :raises NodeChanged: it does not; or there was nothing to compare.
    :raises RsltraceError: it cannot be replayed.
    """
    __tracebackhide__ = True
    from rsltrace.replay import replay_trace
    from rsltrace.replay.one_node.result import as_text

    bags = [bag] if isinstance(bag, (str, os.PathLike)) else bag or ()
    result = replay_trace(
        Path(trace),
        node=node,
        bag=[Path(one) for one in bags],
        options=options,
        job_folder=None if job_folder is None else Path(job_folder),
        trust=True,
    )
    if result.diverged or not result.compared:
        raise NodeChanged("\n".join(as_text(result, everything=False)))
    return result
