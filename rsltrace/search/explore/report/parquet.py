"""The runs of a search as a Parquet table, one row each, for DuckDB, pandas and the like.

What was varied and every metric have columns of their own (``set.nodes.0.parameters.speed``,
``metric.error``), so tables of several searches are merged by the names of their columns.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rsltrace.errors import ExploreError
from rsltrace.search.explore.report.exploration import Exploration, settings
from rsltrace.search.explore.trial import TrialResult


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
    beside = path.with_name(f".{path.name}.part")
    try:
        parquet.write_table(table, beside)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


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
