"""Where two runs first part, and why. Reads traces and bags; needs no ROS.

>>> import rsltrace
>>> result = rsltrace.diff("a.mcap", "b.mcap")            # doctest: +SKIP
>>> result.verdict, result.sentence                       # doctest: +SKIP

This package is also that function: ``rsltrace.diff(a, b)`` calls ``diff_files`` below. Importing it
loads nothing but names.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from rsltrace.diff.model import Diff


def diff_files(a: Path | str, b: Path | str, **options: Any) -> Diff:
    """Compare two traces: paths, or addresses such as ``https://…`` given as strings.

    ``options`` are the fields of ``rsltrace.DiffOptions``: ``context``, ``everything``, ``nodes``,
    ``topics``, ``ignore``, ``absolute``, ``relative``, ``window``.

    Returns a ``rsltrace.Diff``; ``identical``, ``verdict`` and ``sentence`` say the most.

    Raises TraceError if a file is missing, damaged or no trace, or if an option makes no sense,
    and SetupError for an address when fsspec is not installed.
    """
    from rsltrace.diff.engine import diff_traces
    from rsltrace.diff.options import DiffOptions
    from rsltrace.trace.reader import Trace

    chosen = DiffOptions(**options)
    with Trace.open(a) as trace_a, Trace.open(b) as trace_b:
        return diff_traces(trace_a, trace_b, chosen)


class _CallablePackage(ModuleType):
    """So that ``rsltrace.diff`` is one thing, whether a function or a package is meant."""

    def __call__(self, a: Path | str, b: Path | str, **options: Any) -> Diff:
        return diff_files(a, b, **options)


_CallablePackage.__call__.__doc__ = diff_files.__doc__
sys.modules[__name__].__class__ = _CallablePackage
