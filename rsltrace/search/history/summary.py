"""What the lines of a history say: which jobs changed their digest, and which fail how often.

Lines come from many machines and files in any order, and there may be a million of them. Of each
only time, job, commit, digest and verdict are kept, as columns of numbers: 25 bytes. Rejected:
DuckDB (three times as fast, twice the memory, one more package), SQLite (five times slower).
"""

from __future__ import annotations

import os
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.errors import TraceError
from rsltrace.search.history.run_record import DIRTY, READER, SUFFIX, RunRecord
from rsltrace.trace.mcap.open import open_source
from rsltrace.trace.mcap.remote import filesystem_of
from rsltrace.trace.mcap.source import ByteSource, public_address, redacted
from rsltrace.trace.model.texts import counted, printable, shortened
from rsltrace.trace.words.phrases import path_word, table

SHOWN_MAX = 100
"""The most jobs, and the most changes, that a summary has."""
COMMITS_MAX = 40
_PIECE = 1 << 20
_LINE_MAX = 1 << 16
_BATCH_BYTES, _BATCH_FILES = 32 << 20, 1000

OnBadLine = Callable[[str, int], object]
"""Receives file and line of what is no line of a history."""


@dataclass(frozen=True, slots=True)
class DigestChange:
    """Two runs of a job on a branch, one after the other, with different digests."""

    job: str
    branch: str
    time: str
    old_commit: str
    old_digest: str
    commit: str
    digest: str

    @property
    def is_unexplained(self) -> bool:
        """Whether both are of the same commit, without changes to its files."""
        return self.commit == self.old_commit != "" and not self.commit.endswith(DIRTY)


@dataclass(slots=True)
class JobHistory:
    """The runs of a job. ``orders`` were tried by searches, ``changes`` counts the changes of its
    digest; the ``last_…`` are of the last run that failed. ``fails_now``: on a branch, the
    last search failed, or the last of the other runs."""

    job: str
    runs: int = 0
    failed: int = 0
    orders: int = 0
    orders_failed: int = 0
    seconds: float = 0.0
    changes: int = 0
    last_time: str = ""
    last_commit: str = ""
    last_reason: str = ""
    fails_now: bool = False

    def add(self, run: RunRecord) -> None:
        self.runs += 1
        self.seconds += run.seconds or 0.0
        if run.by == "explore" and run.verdict != "error":
            self.orders += run.runs
            self.orders_failed += run.failed
        if run.verdict != "passed":
            self.failed += 1
            if run.time >= self.last_time:
                self.last_time, self.last_commit = run.time, run.commit
                self.last_reason = run.reason


@dataclass(slots=True)
class CommitResult:
    """The runs of a job at a commit, and whether its digest changed there."""

    runs: int = 0
    failed: int = 0
    changed: bool = False


@dataclass(frozen=True, slots=True)
class HistorySummary:
    """What a history says. ``changes`` are the last ones, the newest first, ``jobs`` those that
    fail in the largest share of their runs first; the ``…_count`` count all. ``commits`` are the
    newest in the order of their first runs, ``results`` what the jobs did at them."""

    runs: int
    first: str
    last: str
    skipped: int
    failed: int
    orders: int
    jobs_count: int
    jobs_failed: int
    jobs_failing_now: int
    commits_count: int
    changes_count: int
    changes: Sequence[DigestChange]
    jobs: Sequence[JobHistory]
    commits: Sequence[str]
    results: dict[tuple[str, str], CommitResult]


def summarize(
    places: Iterable[str],
    *,
    job: str = "*",
    branch: str = "*",
    since: str = "",
    on_bad: OnBadLine = lambda name, line: None,
) -> HistorySummary:
    """Return what the histories at ``places`` (files, folders, addresses) say of the jobs and
    branches that fit the globs, ``since`` a date.

    :raises TraceError: one cannot be read.
    """
    table = _Table()
    skipped = 0

    def skip(name: str, line: int) -> None:
        nonlocal skipped
        skipped += 1
        on_bad(name, line)

    for place in places:
        for one in _records(place, skip):
            if one.time >= since and fnmatchcase(one.job, job) and fnmatchcase(one.branch, branch):
                table.add(one)
    return table.summary(skipped)


class _Table:
    """The runs as columns of numbers; texts that occur in many runs are kept once."""

    def __init__(self) -> None:
        self._jobs: dict[str, JobHistory] = {}
        self._newest: dict[tuple[str, str, bool], tuple[str, bool]] = {}
        self._series: dict[tuple[str, str], int] = {}
        self._commits: dict[str, int] = {}
        self._times, self._digest_of = array("q"), array("Q")
        self._series_of, self._commit_of, self._fails = array("i"), array("i"), array("b")

    def add(self, run: RunRecord) -> None:
        job = self._jobs.get(run.job)
        if job is None:
            job = self._jobs[run.job] = JobHistory(run.job)
        job.add(run)
        kind = run.job, run.branch, run.by == "explore"
        last = run.time, run.verdict != "passed"
        self._newest[kind] = max(self._newest.get(kind, last), last)
        self._times.append(int(run.time.encode().translate(None, b"-:T.Z")))
        self._series_of.append(self._series.setdefault((run.job, run.branch), len(self._series)))
        self._commit_of.append(self._commits.setdefault(run.commit, len(self._commits)))
        self._digest_of.append(int(run.digest or "0", 16))
        self._fails.append(run.verdict != "passed")

    def summary(self, skipped: int) -> HistorySummary:
        times, commits = np.array(self._times), np.array(self._commit_of)
        series, names = [*self._series], [*self._commits]
        before, after = self._changes(times)
        changed = Counter((series[self._series_of[row]][0], self._commit_of[row]) for row in after)
        for (job, _), count in changed.items():
            self._jobs[job].changes += count
        for (job, _, _), (_, fails) in self._newest.items():
            self._jobs[job].fails_now |= fails
        seen, first = np.unique(commits[np.argsort(times, kind="stable")], return_index=True)
        in_time = [one for one in seen[np.argsort(first)].tolist() if names[one]]
        newest = in_time[-COMMITS_MAX:]
        shown = sorted(
            self._jobs.values(), key=lambda one: (-one.failed / one.runs, -one.changes, one.job)
        )[:SHOWN_MAX]
        shown_names = {one.job for one in shown}
        results: dict[tuple[str, str], CommitResult] = {}
        for row in np.flatnonzero(np.isin(commits, newest)).tolist():
            job, commit = series[self._series_of[row]][0], self._commit_of[row]
            if job not in shown_names:
                continue
            result = results.setdefault((job, names[commit]), CommitResult())
            result.runs += 1
            result.failed += self._fails[row]
            result.changed = (job, commit) in changed
        return HistorySummary(
            len(times),
            *((_time_text(times.min()), _time_text(times.max())) if len(times) else ("", "")),
            skipped,
            sum(self._fails),
            sum(one.orders for one in self._jobs.values()),
            len(self._jobs),
            sum(one.failed > 0 for one in self._jobs.values()),
            sum(one.fails_now for one in self._jobs.values()),
            len(in_time),
            len(after),
            [
                DigestChange(
                    *series[self._series_of[row]],
                    _time_text(times[row]),
                    names[self._commit_of[old]],
                    f"{self._digest_of[old]:016x}",
                    names[self._commit_of[row]],
                    f"{self._digest_of[row]:016x}",
                )
                for old, row in [*zip(before, after, strict=True)][: -SHOWN_MAX - 1 : -1]
            ],
            shown,
            [names[one] for one in newest],
            results,
        )

    def _changes(self, times: npt.NDArray[np.int64]) -> tuple[list[int], list[int]]:
        """Return the rows before and after each change of a digest, in the order of time."""
        digests, series = np.array(self._digest_of), np.array(self._series_of)
        order = np.lexsort((times, series))
        order = order[digests[order] != 0]
        before, after = order[:-1], order[1:]
        differ = (digests[before] != digests[after]) & (series[before] == series[after])
        before, after = before[differ], after[differ]
        order = np.argsort(times[after], kind="stable")
        return before[order].tolist(), after[order].tolist()


def _time_text(digits: int) -> str:
    text = f"{digits:017d}"
    return f"{text[:4]}-{text[4:6]}-{text[6:8]} {text[8:10]}:{text[10:12]}"


def _records(place: str, on_bad: OnBadLine) -> Iterator[RunRecord]:
    read = READER.validator.validate_json
    for name, lines in _files(place):
        for number, line in enumerate(lines, 1):
            try:
                if len(line) > _LINE_MAX:
                    raise ValueError
                yield read(line)
            except ValueError:
                on_bad(name, number)


def _files(place: str) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the files of a history with their lines."""
    if "://" not in place:
        paths = sorted(Path(place).rglob(f"*{SUFFIX}")) if Path(place).is_dir() else [Path(place)]
        if not paths:
            raise TraceError(f"the folder {place} has no {SUFFIX} files: it is no history")
        for path in paths:
            with closing(open_source(path)) as source:
                yield str(path), _lines(source)
    elif place.endswith(SUFFIX):
        with closing(open_source(place)) as source:
            yield source.name, _lines(source)
    else:
        yield from _files_at(place)


def _files_at(address: str) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the files of a folder elsewhere: small ones are fetched many at a time."""
    filesystem, path = filesystem_of(address)
    name = public_address(address)
    try:
        found = filesystem.find(path, detail=True)
        sizes = {one: about["size"] or 0 for one, about in found.items() if one.endswith(SUFFIX)}
        if not sizes:
            with suppress(FileNotFoundError):
                filesystem.ls(path)  # "find" is silent about a server that cannot be reached
            raise TraceError(f"{name} has no {SUFFIX} files: it is no history")
        batch: list[str] = []
        for one, size in sorted(sizes.items()):
            if size > _PIECE:
                with closing(open_source(filesystem.unstrip_protocol(one))) as source:
                    yield source.name, _lines(source)
                continue
            batch.append(one)
            if len(batch) >= _BATCH_FILES or sum(map(sizes.__getitem__, batch)) > _BATCH_BYTES:
                yield from _fetched(filesystem, batch)
                batch = []
        yield from _fetched(filesystem, batch)
    except TraceError:
        raise
    except Exception as error:  # whatever the storage's library raises: there are many
        reason = redacted(str(error) or type(error).__name__, address)
        raise TraceError(f"{name} cannot be read: {reason}") from None


def _fetched(filesystem: Any, paths: list[str]) -> Iterator[tuple[str, Iterable[bytes]]]:
    for name, data in (filesystem.cat(paths) if paths else {}).items():
        yield public_address(name), data.splitlines()


def _lines(source: ByteSource) -> Iterator[bytes]:
    """Yield lines; one that is too long is cut, and still too long."""
    rest = b""
    for offset in range(0, source.size, _PIECE):
        piece = source.read_at(offset, min(_PIECE, source.size - offset))
        *lines, rest = (rest[: _LINE_MAX + 1] + piece).split(b"\n")
        yield from lines
    if rest:
        yield rest


# The report, and its lines for the page.


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
