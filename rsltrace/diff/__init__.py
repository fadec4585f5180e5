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
    from typing import Any

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
    by: str = "order",
    allow_truncated: bool = False,
    check: bool = False,
) -> Diff | Any:
    """Compare two traces: paths, or addresses such as ``https://…`` given as strings. Or two
    recordings: folders with metadata.yaml, ``.mcap`` or ``.db3`` files; one may be a trace.

    ``context`` is the number of events shown before a divergence. ``everything`` looks at both runs
    to their ends and tells every independent divergence; else ``window`` events after the first
    one are aligned. ``nodes`` and ``topics`` are globs of what to tell about.

    ``ignore`` are globs of fields that are not compared (``header.stamp``, ``/odom:twist``).
    ``absolute`` and ``relative`` give tolerances by such globs: ``{"pose.*": 1e-6}``, or pairs.

    A truncated trace is never identical to another; with ``allow_truncated`` it passes if it
    agrees up to its end. ``check`` first verifies the hashes of both traces. ``by`` says how
    the messages of recordings are matched: ``order`` or ``stamp``.

    Returns a ``rsltrace.Diff``, or a ``rsltrace.BagDiff`` of recordings; ``identical``, ``verdict``
    and ``sentence`` say the most, and ``rsltrace.diff.report.render`` makes a report of it.

    Raises TraceError or BagError if a file is missing or damaged, or if an option makes no sense,
    and SetupError for an address when fsspec is not installed.
    """
    from rsltrace.diff.file_kind import is_recording
    from rsltrace.diff.options import BY_ORDER, DiffOptions
    from rsltrace.diff.traces.diff import diff_traces
    from rsltrace.errors import TraceError
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
        by=by,
        allow_truncated=allow_truncated,
    )
    if is_recording(a) or is_recording(b):
        from rsltrace.diff.bags.comparison import diff_bags

        if nodes or check:
            raise TraceError("nodes and check need two traces: a recording has neither of them")
        return diff_bags(a, b, chosen)
    if by != BY_ORDER:
        raise TraceError(f"by={by!r} is for recordings; the events of two traces are aligned")
    with Trace.open(a) as trace_a, Trace.open(b) as trace_b:
        for trace in (trace_a, trace_b) if check else ():
            from rsltrace.trace.contents import check_contents  # it needs numpy

            trace.check()
            check_contents(trace)
        return diff_traces(trace_a, trace_b, chosen)


def _globs(globs: str | Sequence[str]) -> tuple[str, ...]:
    return (globs,) if isinstance(globs, str) else tuple(globs)


def _pairs(tolerances: Tolerances) -> tuple[tuple[str, float], ...]:
    return tuple(tolerances.items() if isinstance(tolerances, Mapping) else tolerances)


make_callable(__name__, diff_files)
