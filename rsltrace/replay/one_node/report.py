"""Format the result of ``replay --node``, as a table or as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict

from rsltrace.replay.one_node.result import NodeReplayResult, OutputChange
from rsltrace.trace.model.texts import format_seconds, printable, shortened
from rsltrace.trace.words.phrases import table

_ROWS = 15
_WIDTH = 40


def as_text(result: NodeReplayResult, *, everything: bool) -> Iterator[str]:
    """Yield the lines of the report: the first changes, or (``everything``) all."""
    yield printable(result.sentence)
    if result.same:
        return
    shown: Sequence[OutputChange] = result.changes
    rows = [row for change in shown for row in _rows(change)]
    left = 0
    if not everything and len(rows) > _ROWS:
        count, shown = 0, []
        for change in result.changes:
            count += len(change.fields)
            if shown and count > _ROWS:
                break
            shown.append(change)
        left = len(result.changes) - len(shown)
        rows = [row for change in shown for row in _rows(change)][:_ROWS]
    yield ""
    yield from table([("time (s)", "output", "field", "recorded", "now"), *rows])
    if left:
        yield f"and {left} more {'output' if left == 1 else 'outputs'} (--all shows them)"


def _rows(change: OutputChange) -> Iterator[tuple[str, ...]]:
    when, name = format_seconds(change.time_ns), printable(change.name)
    output = name if change.kind == "message" else f"{change.kind} {name}"
    for one in change.fields:
        path, before, after = one.path, one.a, one.b
        if one.first and one.elements is not None:  # of an array, the first element that differs
            place, before, after = one.first[0]
            others = one.elements[0] - 1
            path += f"[{place}]" + (f" and {others} more" if others else "")
        before, after = shortened(before, _WIDTH), shortened(after, _WIDTH)
        yield when, output, printable(path), before or "(nothing)", after or "(nothing)"


def as_json(result: NodeReplayResult) -> str:
    return json.dumps(
        {
            "trace": result.trace,
            "node": result.node,
            "inputs": result.inputs,
            "compared": result.compared,
            "same": result.same,
            "changes": [_values(change) for change in result.changes],
            "end_ns": result.end_ns,
            "ended": result.ended,
            "exit_code": result.exit_code,
            "error": None if result.error is None else str(result.error),
            "path": None if result.path is None else str(result.path),
            "notes": list(result.notes),
        }
    )


def _values(change: OutputChange) -> dict[str, object]:
    return {
        "change": change.change.value,
        "time_ns": change.time_ns,
        "kind": change.kind,
        "name": change.name,
        "recorded_event": change.recorded_event,
        "event": change.event,
        "fields": [asdict(one) for one in change.fields],
    }
