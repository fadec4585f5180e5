"""A search for machines: JSON, JUnit for CI servers, annotations for GitHub."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from rsltrace.diff.report.ci import command_data, command_property
from rsltrace.errors import ExploreError
from rsltrace.search.explore.report.exploration import (
    Exploration,
    FailureCause,
    causes,
    effects,
    repeat_command,
    settings,
    view_command,
)
from rsltrace.search.explore.trial import TrialResult
from rsltrace.trace.model.regular_file import replacement_of
from rsltrace.trace.model.texts import printable, printable_lines

# The runs of a search as a Parquet table, one row each, for DuckDB, pandas and the like.
#
# What was varied and every metric have columns of their own (``set.nodes.0.parameters.speed``,
# ``metric.error``), so tables of several searches are merged by the names of their columns.


def write_parquet(explored: Exploration, path: Path) -> None:
    """Write the table; an older one is replaced when it is whole.

    :raises ExploreError: pyarrow is not installed.
    :raises OSError: it cannot be written.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise ExploreError("a Parquet table needs pip install 'rsltrace[explore]'") from None
    rows = [_row(explored, one) for one in explored.results]
    fixed = dict(_COLUMNS)
    names = list(dict.fromkeys([*fixed, *(name for row in rows for name in row)]))
    columns, types = [], []
    for name in names:
        values = [row.get(name) for row in rows]
        kind = fixed.get(name)
        if kind is None:  # a setting that is a number in one run and a text in another is a text
            is_text = any(isinstance(value, str) for value in values)
            kind = "string" if is_text else "float64"
            if is_text:
                values = [None if value is None else str(value) for value in values]
        columns.append(values)
        types.append(pa.field(name, getattr(pa, kind)()))
    table = pa.table(columns, schema=pa.schema(types))
    with replacement_of(path) as work:
        parquet.write_table(table, work)


_COLUMNS = (
    ("job", "string"),
    ("strategy", "string"),
    ("run", "int64"),
    ("tries", "string"),
    ("seed", "int64"),
    ("overlay", "string"),
    ("digest", "string"),
    ("final_state", "string"),
    ("verdict", "string"),
    ("cause", "string"),
    ("text", "string"),
    ("event", "int64"),
    ("events", "int64"),
    ("choices", "int64"),
    ("simulated_s", "float64"),
    ("wall_s", "float64"),
    ("trace", "string"),
)
"""Columns that every table has, with the types that pyarrow calls them by."""


def _row(explored: Exploration, result: TrialResult) -> dict[str, Any]:
    failure = result.failure
    overlay = result.trial.overlay
    values: dict[str, Any] = {
        "job": explored.job,
        "strategy": explored.strategy,
        "run": result.trial.number,
        "tries": result.trial.why,
        "seed": overlay.get("seed"),
        "overlay": json.dumps(dict(overlay)),
        "digest": result.digest,
        "final_state": result.final_state,
        "verdict": "kept" if failure is None else failure.kind,
        "cause": None if failure is None else failure.key,
        "text": None if failure is None else failure.text,
        "event": None if failure is None else failure.event,
        "events": result.events,
        "choices": result.choices,
        "simulated_s": result.end_ns / 1e9,
        "wall_s": result.wall_s,
        "trace": result.trace,
    }
    values.update({f"set.{name}": value for name, value in settings(result.trial).items()})
    values.update({f"metric.{name}": float(value) for name, value in result.metrics.items()})
    return values


def json_values(explored: Exploration) -> dict[str, Any]:
    """Return a search as JSON values: its numbers, its failures by cause, what matters."""
    return {
        "job": explored.job,
        "strategy": explored.strategy,
        "runs": len(explored.results),
        "failed": len(explored.failed),
        "checks": explored.checks,
        "caution": explored.caution,
        "digests": explored.digests,
        "wall_s": round(explored.wall_s, 3),
        "coverage": list(explored.coverage),
        "causes": [_cause_values(explored, cause) for cause in causes(explored)],
        "effects": _effect_values(explored),
    }


def json_text(explored: Exploration) -> str:
    """Return a search as one line of JSON."""
    return json.dumps(json_values(explored))


def _cause_values(explored: Exploration, cause: FailureCause) -> dict[str, Any]:
    shown = cause.shortest
    reduced = cause.reduced
    return {
        "key": cause.key,
        "kind": cause.failure.kind,
        "text": cause.failure.text,
        "runs": len(cause.runs),
        "first_run": cause.first.trial.number,
        "why": cause.first.trial.why,
        "overlay": dict(cause.first.trial.overlay),
        "digest": cause.first.digest,
        "event": cause.first.failure.event if cause.first.failure else None,
        "trace": shown.trace,
        "repeat": repeat_command(explored, shown),
        "view": view_command(shown),
        "reduced": None if reduced is None else reduced.folder,
        "decides": None if reduced is None else reduced.decides,
    }


def _effect_values(explored: Exploration) -> list[dict[str, Any]]:
    if not any(settings(one.trial) for one in explored.results):
        return []
    try:
        found = effects(explored.results)
    except ExploreError:  # without scipy; the page says so
        return []
    return [asdict(one) for one in found]


def junit_text(explored: Exploration) -> str:
    """Return a search as JUnit XML: a test that failed for each cause, one that passed if none."""
    found = causes(explored)
    count = str(max(len(found), 1))
    numbers = {"tests": count, "failures": str(len(found)), "errors": "0"}
    time = f"{explored.wall_s:.3f}"
    suites = Element("testsuites", {"name": "rsltrace explore", **numbers, "time": time})
    suite = SubElement(
        suites, "testsuite", {"name": printable(explored.job), **numbers, "time": time}
    )
    for cause in found:
        case = _case(suite, explored, f"{cause.failure.kind}: {cause.key}")
        said = f"{len(cause.runs)} of {len(explored.results)} runs: {cause.failure.text}"
        kind = {"type": cause.failure.kind, "message": printable(said)}
        SubElement(case, "failure", kind).text = printable_lines(_details(explored, cause))
    if not found:
        case = _case(suite, explored, f"{len(explored.results)} runs")
        if explored.caution:
            SubElement(case, "system-out").text = explored.caution
    indent(suites)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + tostring(suites, encoding="unicode")


def _case(suite: Element, explored: Exploration, name: str) -> Element:
    return SubElement(
        suite, "testcase", {"classname": printable(explored.job), "name": printable(name)}
    )


def _details(explored: Exploration, cause: FailureCause) -> str:
    lines = [cause.failure.text]
    if cause.reduced is not None:
        lines += [cause.reduced.decides, f"made small in {cause.reduced.folder}"]
    shown = cause.shortest
    lines += [line for line in (repeat_command(explored, shown), view_command(shown)) if line]
    return "\n".join(filter(None, lines))


def github_text(explored: Exploration) -> str:
    """Return a search as workflow commands of GitHub Actions: an error for each cause, at the line
    it names or else at the job, and a notice where there is none."""
    found = causes(explored)
    if not found:
        name = command_property(printable(_from_here(explored.job)))
        said = f"{len(explored.results)} runs, none failed"
        said += f"; {explored.caution}" if explored.caution else ""
        return f"::notice file={name}::{command_data(printable_lines(said))}"
    lines = []
    for cause in found:
        file, line = _place(explored, cause)
        where = f"file={command_property(printable(file))}" + (f",line={line}" if line else "")
        title = command_property(printable(f"{cause.failure.kind}: {cause.key}"))
        said = f"{len(cause.runs)} of {len(explored.results)} runs\n{_details(explored, cause)}"
        lines.append(f"::error {where},title={title}::{command_data(printable_lines(said))}")
    return "\n".join(lines)


def _place(explored: Exploration, cause: FailureCause) -> tuple[str, int | None]:
    if cause.place is None:
        return _from_here(explored.job), None
    file, line = cause.place
    return _from_here(os.path.join(os.path.dirname(explored.job), file)), line


def _from_here(path: str) -> str:
    """Return a path as GitHub wants it: from the folder of the checkout."""
    shown = os.path.relpath(path)
    return Path(os.path.abspath(path) if shown.startswith("..") else shown).as_posix()
