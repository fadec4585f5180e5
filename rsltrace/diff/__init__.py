"""Where two runs first diverge, and why. Reads traces and bags; needs no ROS.

>>> import rsltrace
>>> result = rsltrace.diff("a.mcap", "b.mcap")            # doctest: +SKIP
>>> result.verdict, result.sentence                       # doctest: +SKIP

This package is also that function: ``rsltrace.diff(a, b)`` calls ``diff_files`` below. Importing it
loads nothing but names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rsltrace.callable_package import make_callable

if TYPE_CHECKING:
    from pathlib import Path

    from rsltrace.diff.result import Diff

    Tolerances = Mapping[str, float] | Sequence[tuple[str, float]]


def diff_files(
    a: Path | str,
    b: Path | str,
    *,
    context: int = 5,
    everything: bool = False,
    nodes: str | Sequence[str] = (),
    topics: str | Sequence[str] = (),
    ignore: str | Sequence[str] = (),
    absolute: Tolerances = (),
    relative: Tolerances = (),
    window: int = 2000,
    as_far_as_they_go: bool = False,
) -> Diff:
    """Compare two traces: paths, or addresses such as ``https://…`` given as strings.

    ``context`` is the number of events told before a divergence. ``everything`` looks at both runs
    to their ends and tells every independent divergence; else ``window`` events after the first
    one are aligned. ``nodes`` and ``topics`` are globs of what to tell about.

    ``ignore`` are globs of fields that are not compared (``header.stamp``, ``/odom:twist``).
    ``absolute`` and ``relative`` give tolerances by such globs: ``{"pose.*": 1e-6}``, or pairs.

    A trace that is cut is never identical to another; with ``as_far_as_they_go`` it passes if it
    agrees until there.

    Returns a ``rsltrace.Diff``; ``identical``, ``verdict`` and ``sentence`` say the most, and
    ``rsltrace.diff.report.render`` makes a report of it. For recordings that are no traces there
    is ``rsltrace.diff_bags``.

    Raises TraceError if a file is missing, damaged or no trace, or if an option makes no sense,
    and SetupError for an address when fsspec is not installed.
    """
    from rsltrace.diff.options import DiffOptions
    from rsltrace.diff.traces.diff import diff_traces
    from rsltrace.trace.reader import Trace

    chosen = DiffOptions(
        context=context,
        everything=everything,
        nodes=_globs(nodes),
        topics=_globs(topics),
        ignore=_globs(ignore),
        absolute=_pairs(absolute),
        relative=_pairs(relative),
        window=window,
        as_far_as_they_go=as_far_as_they_go,
    )
    with Trace.open(a) as trace_a, Trace.open(b) as trace_b:
        return diff_traces(trace_a, trace_b, chosen)


def _globs(globs: str | Sequence[str]) -> tuple[str, ...]:
    return (globs,) if isinstance(globs, str) else tuple(globs)


def _pairs(tolerances: Tolerances) -> tuple[tuple[str, float], ...]:
    return tuple(tolerances.items() if isinstance(tolerances, Mapping) else tolerances)


make_callable(__name__, diff_files)
