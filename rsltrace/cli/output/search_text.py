"""The reports of ``rsltrace bisect`` and ``rsltrace explore``."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.diff import diff_files
from rsltrace.diff.report import render
from rsltrace.search.explore.search import Explorer, SearchTally
from rsltrace.search.explore.small.causes import FAILING, JOB, PASSING, PASSING_JOB
from rsltrace.search.explore.trial import JobSource, TrialResult
from rsltrace.trace.model.texts import counted

if TYPE_CHECKING:
    from rsltrace.diff.result import Diff
    from rsltrace.search.bisect.repository import Commit, GitRepository
    from rsltrace.search.bisect.search import BisectResult, TestedRevision
    from rsltrace.search.explore.small.causes import ReducedFailure

_FILES_MAX = 12
Kept = tuple[Path, Path] | None


def line_of(tried: TestedRevision) -> str:
    """Return the result of a revision in a line, and why it failed in another."""
    run = tried.run
    what = f"digest {run.digest}, {run.events} events" if run.digest else "no run"
    failure = tried.why or run.failure
    why = f"\n      {failure.splitlines()[0]}" if failure else ""
    return f"{tried.answer.value:<4}  {tried.commit.short}  {what}  {tried.commit.subject}{why}"


def as_text(found: BisectResult, repository: GitRepository, kept: Kept) -> str:
    """Return the report; ``kept`` are the paths of the traces, None if they are deleted."""
    first = found.first
    lines = [_answer(found)]
    if first is not None:
        if len(first.parents) > 1:
            lines.append(f"  a merge of {len(first.parents)} commits without the change")
        lines += _files(repository.changed_files(first))
    else:
        lines += [f"  {commit}" for commit in found.candidates]
    difference = _difference(found, kept)
    report = render(difference).rstrip().splitlines()
    if kept is None:  # the traces are deleted
        report = [line for line in report if not line.startswith("next: ")]
    lines += ["", *report]
    lines += [f"the traces are {kept[0]} and {kept[1]}"] if kept else []
    return "\n".join(lines)


def _answer(found: BisectResult) -> str:
    if (first := found.first) is not None:
        return f"first changed at {first}  ({first.author}, {first.date})"
    count = len(found.candidates)
    return f"first changed at one of these {count} commits; the skipped ones cannot tell which"


def as_page(found: BisectResult, repository: GitRepository, kept: tuple[Path, Path]) -> str:
    from rsltrace_viewer.pages.search_page import search_page

    rows = [("tried", "\n".join(map(line_of, found.tried)))]
    if found.first is not None:
        rows.append(("changed files", "\n".join(_files(repository.changed_files(found.first)))))
    return search_page(_answer(found), rows, (), kept)


def as_values(found: BisectResult, repository: GitRepository, kept: Kept) -> dict[str, Any]:
    first = found.first
    return {
        "first": None if first is None else _commit(first),
        "files": [] if first is None else list(repository.changed_files(first)),
        "candidates": [_commit(commit) for commit in found.candidates],
        "tried": [_tried(one) for one in found.tried],
        "before": found.before.commit.id,
        "after": found.after.commit.id,
        "notes": list(found.notes),
        "kept": [str(path) for path in kept or ()],
        "diff": json.loads(render(_difference(found, kept), "json")),
    }


def _files(names: Sequence[str]) -> list[str]:
    shown = [f"  {name}" for name in names[:_FILES_MAX]]
    more = len(names) - len(shown)
    return [*shown, f"  and {more} more files"] if more else shown


def _difference(found: BisectResult, kept: Kept) -> Diff:
    before, after = found.before, found.after
    if kept is not None:
        return diff_files(*kept)
    result = diff_files(before.run.path, after.run.path)
    return replace(
        result,
        a=replace(result.a, path=f"at {before.commit.short}"),
        b=replace(result.b, path=f"at {after.commit.short}"),
    )


def _commit(commit: Commit) -> dict[str, Any]:
    return {
        "commit": commit.id,
        "date": commit.date,
        "author": commit.author,
        "subject": commit.subject,
        "parents": list(commit.parents),
    }


def _tried(tried: TestedRevision) -> dict[str, Any]:
    run = tried.run
    return {
        **_commit(tried.commit),
        "answer": tried.answer.value,
        "why": tried.why,
        "digest": run.digest,
        "events": run.events,
        "exit_code": run.exit_code,
        "error": run.failure,
    }


_CAUSES_MAX = 20
_TEXT_MAX = 300
_FAILURE_LINES_MAX = 3


def search_lines(
    search: Explorer, source: JobSource, folder: Path, *, caution: str = "", quiet: bool = False
) -> Iterator[str]:
    """Yield the lines of the summary; ``caution`` says what was not checked. ``quiet``: without
    how the search went."""
    tally = search.tally
    failed = sum(tally.failures.values())
    yield (
        f"{counted(tally.runs, 'run')}, {counted(len(tally.digests), 'different digest')}, "
        f"{failed} failed" + (f" of {counted(len(tally.failures), 'cause')}" if failed else "")
    )
    if caution:
        yield caution
    if tally.plain is not None and tally.plain.failure is not None:
        yield "the job fails in its default order, without a search"
    for key in _by_frequency(tally)[:_CAUSES_MAX]:
        yield from _cause(tally.first[key], tally.failures[key], source)
    more = len(tally.failures) - _CAUSES_MAX
    if more > 0:
        yield f"and {counted(more, 'more cause')}"
    if not quiet:
        yield from search.strategy.coverage()
        if tally.forked:
            yield f"{counted(tally.forked, 'run')} forked from the default run"
        for why, count in tally.not_forked.most_common():
            yield f"{counted(count, 'run')} run from the start: {why}"
    if search.is_exhausted:
        yield "every run has been tried"
    yield f"results: {folder}; report: {folder / 'report.html'}"


_EXACT_TIME = (
    "if it passes outside the simulation: simulated time stops exactly where a wait ends, and "
    "messages due in that instant come after it"
)


def flaky_lines(
    search: Explorer, folder: Path, small: Mapping[str, ReducedFailure]
) -> Iterator[str]:
    """Yield the lines of what a search found about a test; ``small`` are its minimized failures."""
    tally = search.tally
    runs = f"{counted(tally.runs, 'run')}, {counted(len(tally.digests), 'different order')}"
    failed = sum(tally.failures.values())
    yield f"it failed in {failed} of {runs}" if failed else f"it never failed in {runs}"
    if failed and failed == tally.runs:
        if failed > 1:  # the only run says nothing of others: --stop-at-first
            yield "it never passed, so it is not flaky"
        yield _EXACT_TIME
    for key in _by_frequency(tally)[:_CAUSES_MAX]:
        failure, count, one = tally.first[key].failure, tally.failures[key], small.get(key)
        assert failure is not None
        yield f"{failure.kind}, {counted(count, 'run')}: {key}"
        yield from (f"  {line}" for line in failure.text.splitlines()[:_FAILURE_LINES_MAX])
        if one is None or one.trouble:
            yield f"  not minimized: {one.trouble if one else 'interrupted'}"
            continue
        yield f"  fails: rsltrace record {shlex.quote(str(one.folder / JOB))}"
        if (one.folder / PASSING_JOB).is_file():
            yield f"  passes: rsltrace record {shlex.quote(str(one.folder / PASSING_JOB))}"
            traces = [str(one.folder / name) for name in (PASSING, FAILING)]
            yield f"  compare: {shlex.join(['rsltrace', 'diff', *traces])}"
    yield f"results: {folder}"


def _by_frequency(tally: SearchTally) -> list[str]:
    """Return the causes, the most frequent first."""
    return sorted(
        tally.failures, key=lambda key: (-tally.failures[key], tally.first[key].trial.number)
    )


def _cause(result: TrialResult, count: int, source: JobSource) -> Iterator[str]:
    failure, trial = result.failure, result.trial
    assert failure is not None
    text = failure.text.splitlines()[0]
    text = text if len(text) <= _TEXT_MAX else f"{text[:_TEXT_MAX]}…"
    yield f"{failure.kind}: {text}"
    yield f"  {counted(count, 'run')}, first trial {trial.number}: {trial.why}"
    if result.trace is not None and Path(result.trace).is_file():
        at = f" --at {failure.event}" if failure.event is not None else ""
        yield f"  view: rsltrace view {shlex.quote(result.trace)}{at}"
    yield f"  reproduce: {source.command(trial)}"
