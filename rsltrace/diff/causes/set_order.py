"""The set whose order shows in a message: found in the code, or by the guard of the run."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Sequence
from pathlib import Path

from rsltrace.diff.alignment.rows import Run
from rsltrace.diff.causes.output_notes import IN_ANOTHER_ORDER
from rsltrace.diff.causes.relevance import Relevance
from rsltrace.diff.result.divergence import CallDifference, MessageDifference
from rsltrace.diff.result.events import EventView
from rsltrace.diff.result.fields import SAME_ELEMENTS, SAME_WORDS
from rsltrace.errors import JobError
from rsltrace.model.finding import Source
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.words.code import code_file, code_place


def set_behind(
    run: Run,
    view: EventView,
    messages: Sequence[MessageDifference],
    calls: Sequence[CallDifference],
    relevance: Relevance,
) -> str:
    """Return ``the order of the set self.landmarks, at ekf.py:58`` where an event sent the same in
    another order; "" if it did not, or if its code goes through no set that a run leaves as it is.
    """
    if not any(map(_is_reordered, messages)):
        return ""
    for call in calls:
        if call.source == Source.ORDER.value:
            return f"the {call.call}, at {call.where.partition(' in ')[0]}"
    if relevance.sets_are_in_order:
        return ""
    place = code_place(run.trace, run.trace.event(view.index))
    found = code_file(run.trace, place)
    if found is None or not _is_as_recorded(run, found[0]):
        return ""
    lines = _lines_with_sets(*found)
    file = place.rpartition(":")[0]
    more = f" (and {len(lines) - 1} more)" if len(lines) > 1 else ""
    return f"the {lines[0][1]}, at {file}:{lines[0][0]}{more}" if lines else ""


def _is_reordered(message: MessageDifference) -> bool:
    notes = [field.note for field in message.fields]
    return message.note == IN_ANOTHER_ORDER or any(
        same in note for note in notes for same in (SAME_ELEMENTS, SAME_WORDS)
    )


def _is_as_recorded(run: Run, file: Path) -> bool:
    try:
        present = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    except OSError:
        return False
    return present in run.trace.metadata(METADATA_SOURCES).values()


def _lines_with_sets(file: Path, line: int) -> list[tuple[int, str]]:
    """Return where a file goes through sets: in the function at a line, or else anywhere."""
    from rsltrace.audit.audit import audit_path  # most diffs do not need it

    try:
        found = [(o.line, o.call) for o in audit_path(file).found if o.kind == Source.ORDER.value]
        tree = ast.parse(file.read_bytes())
    except (JobError, OSError, SyntaxError, ValueError):
        return []
    ends = (
        node.end_lineno or line
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.lineno == line
    )
    end = next(ends, line)
    return [one for one in found if line <= one[0] <= end] or found
