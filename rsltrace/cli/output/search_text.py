"""What came of a search, for people."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

from rsltrace.search.explore.search import Search, Tally
from rsltrace.search.explore.trial import JobSource, TrialResult, overrides_of

_CAUSES_MAX = 20
_TEXT_MAX = 300


def search_lines(
    search: Search, source: JobSource, folder: Path, *, caution: str = ""
) -> Iterator[str]:
    """Yield the lines of the summary: what was tried, what failed, how to see it; ``caution`` is
    what was not looked for."""
    tally = search.tally
    failed = sum(tally.failures.values())
    yield (
        f"{_counted(tally.runs, 'run')}, {_counted(len(tally.digests), 'different digest')}, "
        f"{failed} failed" + (f" of {_counted(len(tally.failures), 'cause')}" if failed else "")
    )
    if caution:
        yield caution
    if tally.plain is not None and tally.plain.failure is not None:
        yield "the job fails as it is: its plain order needs no search"
    for key in _by_frequency(tally)[:_CAUSES_MAX]:
        yield from _cause(tally.first[key], tally.failures[key], source)
    more = len(tally.failures) - _CAUSES_MAX
    if more > 0:
        yield f"and {_counted(more, 'more cause')}"
    yield from search.strategy.coverage()
    if tally.forked:
        yield f"{_counted(tally.forked, 'run')} forked from the plain one"
    for why, count in tally.not_forked.most_common():
        yield f"{_counted(count, 'run')} made from the beginning: {why}"
    if search.is_exhausted:
        yield "nothing is left to try"
    yield f"results: {folder}, as a page: {folder / 'report.html'}"


def _by_frequency(tally: Tally) -> list[str]:
    """Return the causes, the most frequent first, whichever came first."""
    return sorted(
        tally.failures, key=lambda key: (-tally.failures[key], tally.first[key].trial.number)
    )


def _cause(result: TrialResult, count: int, source: JobSource) -> Iterator[str]:
    failure, trial = result.failure, result.trial
    assert failure is not None
    text = failure.text.splitlines()[0]
    text = text if len(text) <= _TEXT_MAX else f"{text[:_TEXT_MAX]}…"
    yield f"{failure.kind}: {text}"
    yield f"  {_counted(count, 'run')}, first trial {trial.number}: {trial.why}"
    if result.trace is not None and Path(result.trace).is_file():
        at = f" --at {failure.event}" if failure.event is not None else ""
        yield f"  see: rsltrace view {shlex.quote(result.trace)}{at}"
    yield f"  again: {repeats(result, source)}"


def repeats(result: TrialResult, source: JobSource) -> str:
    """Return the command that makes the run of a trial again."""
    words = ["rsltrace", "record"]
    if source.text is None:
        words.append(source.path)
    for _, text in (*source.overrides, *overrides_of(result.trial)):
        words += ["--set", text]
    return shlex.join(words)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"
