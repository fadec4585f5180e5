"""The results of the checks and metrics of a job, as text and JSON."""

from __future__ import annotations

import shlex
from math import isfinite
from pathlib import Path
from typing import Any

from rsltrace.checks.evaluate import (
    UNDECIDED,
    VIOLATED,
    CheckResult,
    evaluate_checks,
    load_function,
)
from rsltrace.checks.metrics import evaluate_metrics
from rsltrace.checks.properties import Violation
from rsltrace.job import Job
from rsltrace.run.process import search_path
from rsltrace.trace.model.texts import format_seconds, printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.code import code_place
from rsltrace.trace.words.events import EventWords

_SHOWN_MAX = 3
_WORDS = {UNDECIDED: "undecided at the end of the run"}


class CheckReport:
    """The checks and metrics of a job on the trace at ``path``. Functions among them are called
    unless ``functions`` is False."""

    def __init__(self, job: Job, path: Path, *, functions: bool = True) -> None:
        self._path = path
        with Trace.open(path) as trace, search_path(job):
            load = load_function if functions else None
            self.results = evaluate_checks(trace, job, load)
            self.metrics = evaluate_metrics(trace, job, load)
            self._start_ns = trace.start_ns
            self._places = {
                one.event: _place(trace, one.event)
                for result in self.results
                for one in result.violations[:_SHOWN_MAX]
                if one.event is not None
            }

    @property
    def violated(self) -> list[CheckResult]:
        return [one for one in self.results if one.verdict == VIOLATED]

    def lines(self) -> list[str]:
        """Return a line for each metric and check, and where each failed one failed."""
        lines = [
            printable(f"metric {one.name}: {one.text}{f' ({one.note})' if one.note else ''}")
            for one in self.metrics
        ]
        for one in self.results:
            note = f" ({one.note})" if one.note else ""
            lines.append(
                printable(f"check {_WORDS.get(one.verdict, one.verdict)}: {one.name}{note}")
            )
            lines += [f"  {self._where(found)}" for found in one.violations[:_SHOWN_MAX]]
            if one.count > _SHOWN_MAX:
                lines.append(f"  and {one.count - _SHOWN_MAX} more")
        first = [
            found.event
            for one in self.violated
            for found in one.violations[:1]
            if found.event is not None
        ]
        if first:
            path = shlex.quote(str(self._path))
            lines.append(f"next: rsltrace view {path} --at {min(first)}")
        return lines

    def values(self) -> dict[str, Any]:
        """Return JSON-compatible values: the ``checks`` in order, the ``metrics`` by name."""
        return {"checks": self._results(), "metrics": self._numbers()}

    def _results(self) -> list[dict[str, Any]]:
        return [
            {
                "name": one.name,
                "verdict": one.verdict,
                "count": one.count,
                "note": one.note,
                "violations": [
                    {"event": found.event, "stamp_ns": found.stamp_ns, "text": found.text}
                    for found in one.violations
                ],
            }
            for one in self.results
        ]

    def _numbers(self) -> dict[str, dict[str, Any]]:
        return {  # JSON has no infinity
            one.name: {
                "value": one.value if one.value is None or isfinite(one.value) else None,
                "unit": one.unit,
                "note": one.note or ("" if isfinite(one.value or 0.0) else str(one.value)),
            }
            for one in self.metrics
        }

    def _where(self, found: Violation) -> str:
        at = "at" if found.event is None else f"event {found.event},"
        place = "" if found.event is None else self._places.get(found.event, "")
        return printable(
            f"{at} {format_seconds(found.stamp_ns - self._start_ns)} s{place}: {found.text}"
        )


def _place(trace: Trace, index: int) -> str:
    event = trace.event(index)
    node = EventWords(trace).node(event, trace.outputs_of(index))
    code = code_place(trace, event)
    return (f", {node}" if node else "") + (f" ({code})" if code else "")
