"""The page of a suite's history: what changed and what fails, and each job at the last commits."""

from __future__ import annotations

from rsltrace.search.history.summary import (
    CommitResult,
    HistorySummary,
    bisect_command,
    change_cells,
    commit_text,
    job_cells,
    summary_line,
)
from rsltrace.trace.model.texts import counted
from rsltrace_viewer.pages.page import render_page


def history_page(found: HistorySummary) -> str:
    return render_page(
        "history.html",
        heading=summary_line(found),
        skipped=counted(found.skipped, "line"),
        found=found,
        numbers=(
            (f"{found.changes_count:,}", "changes of a digest"),
            (f"{found.failed:,}", "runs failed"),
            (f"{found.jobs_failing_now:,}", "jobs that fail now"),
            (f"{found.orders:,}", "orders tried"),
        ),
        changes=[change_cells(one) for one in found.changes],
        failing=[job_cells(one) for one in found.jobs if one.failed],
        commits=[commit_text(one) for one in reversed(found.commits)],
        rows=[
            (one.job, [_cell(found.results.get((one.job, at))) for at in reversed(found.commits)])
            for one in found.jobs
        ],
        command=bisect_command(found),
    )


def _cell(result: CommitResult | None) -> tuple[str, str]:
    """Return the kind of a cell, and what it says."""
    if result is None:
        return "", "not run"
    text = f"{result.failed:,} of {counted(result.runs, 'run')} failed"
    kind = "bad" if result.failed else "good"
    return (f"{kind} changed", f"{text}, digest changed") if result.changed else (kind, text)
