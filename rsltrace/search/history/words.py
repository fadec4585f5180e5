"""The report of a history, and its lines for the page."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rsltrace.trace.model.texts import printable, shortened
from rsltrace.trace.words.phrases import path_word, table

if TYPE_CHECKING:
    from rsltrace.search.history.summary import DigestChange, HistorySummary, JobHistory

_CHANGES_MAX = 20
_JOBS_MAX = 30
_COMMIT_DIGITS = 10
_TEXT_MAX = 100
_COMMIT = re.compile("[0-9a-f]{40,64}")


def as_text(found: HistorySummary) -> Iterator[str]:
    """Yield the lines of the report."""
    yield summary_line(found)
    changes = found.changes[:_CHANGES_MAX]
    if changes:
        yield from ("", "digest changed:")
        yield from table([*map(change_cells, changes)])
        if found.changes_count > len(changes):
            yield f"and {found.changes_count - len(changes):,} earlier changes"
    failing = [one for one in found.jobs if one.failed]
    if failing:
        yield from ("", "failing:")
        yield from table([*map(job_cells, failing[:_JOBS_MAX])])
        if found.jobs_failed > _JOBS_MAX:
            yield f"and {found.jobs_failed - _JOBS_MAX:,} more jobs: see --job, --format json"
    if command := bisect_command(found):
        yield from ("", f"next: {command}")


def summary_line(found: HistorySummary) -> str:
    """Return how much there is."""
    if not found.runs:
        return "no runs"
    return (
        f"{counted(found.runs, 'run')} of {counted(found.jobs_count, 'job')} at "
        f"{counted(found.commits_count, 'commit')}, {found.first[:10]} to {found.last[:10]}"
    )


def counted(count: int, what: str) -> str:
    """Return a number of things."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def change_cells(one: DigestChange) -> tuple[str, ...]:
    """Return a line on a change of a digest."""
    commits = f"{commit_text(one.old_commit)}..{commit_text(one.commit)}"
    if one.is_unexplained:
        commits = f"{commit_text(one.commit)}: the same commit"
    job = shortened(printable(one.job), _TEXT_MAX)
    branch = shortened(printable(one.branch), _TEXT_MAX)
    return one.time, job, branch, f"{one.old_digest} → {one.digest}", commits


def job_cells(one: JobHistory) -> tuple[str, ...]:
    """Return a line on a job that fails."""
    orders = ""
    if one.orders:
        part = share(one.orders_failed, one.orders)
        orders = f"{one.orders_failed:,} of {one.orders:,} orders ({part})"
    return (
        shortened(printable(one.job), _TEXT_MAX),
        f"{one.failed:,} of {counted(one.runs, 'run')} ({share(one.failed, one.runs)})",
        orders,
        f"last at {commit_text(one.last_commit)}, {one.last_time[:10]}{', still' * one.fails_now}",
        shortened(printable(one.last_reason), _TEXT_MAX),
    )


def share(part: int, whole: int) -> str:
    """Return a share in percent."""
    return f"{100 * part / whole:.3g} %"


def commit_text(commit: str) -> str:
    oid, dash, rest = commit.partition("-")
    short = shortened(f"{oid[:_COMMIT_DIGITS]}{dash}{rest}", 2 * _COMMIT_DIGITS)
    return printable(short) or "unknown"


def bisect_command(found: HistorySummary) -> str:
    """Return the command that finds the commit of the last change of a job that is a file here, ""
    if there is none: a history may come from anybody, and commands are pasted."""
    for one in found.changes:
        commits = one.old_commit, one.commit
        is_range = commits[0] != commits[1] and all(map(_COMMIT.fullmatch, commits))
        if is_range and Path(one.job).suffix in (".yaml", ".yml") and os.path.isfile(one.job):
            good, bad = map(commit_text, commits)
            return f"rsltrace bisect {path_word(one.job)} --good {good} --bad {bad}"
    return ""
