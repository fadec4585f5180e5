"""Reduce the failures of a search, one run of each cause, each to a folder that reproduces it."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsltrace.errors import ExploreError
from rsltrace.job import Job, job_from_text, load_job
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.small.reduction import OverlayParts, ReducedTrial, TrialReduction
from rsltrace.search.explore.table import SMALL
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult
from rsltrace.search.explore.workers import Worker
from rsltrace.trace.model.texts import format_seconds, printable

_TEST = '''"""The run in this folder still fails: {why}

When the bug is fixed this test fails: delete it then.
"""

import json
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent


def test_the_run_fails_bit_for_bit(tmp_path):
    words = ["record", str(FOLDER / "job.yaml"), "--json", "-o", str(tmp_path / "run.mcap")]
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", *words], capture_output=True, text=True
    )
    assert done.stdout, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["digest"] == "{digest}"
    assert done.returncode != 0
'''


def test_module(failing: TrialResult) -> str:
    """Return a test that runs the job of its folder."""
    return _TEST.format(why=_one_line(failing).replace('"', "'"), digest=failing.digest)


def readme(reduced: ReducedTrial, failing: TrialResult, passing: TrialResult | None) -> str:
    """Return what the folder is, how to see it fail, and what the failure needs."""
    return "\n".join(_lines(reduced, failing, passing)) + "\n"


def _lines(
    reduced: ReducedTrial, failing: TrialResult, passing: TrialResult | None
) -> Iterator[str]:
    yield "# A run that fails"
    yield ""
    assert failing.failure is not None
    yield from (f"    {printable(line)}" for line in failing.failure.text.splitlines())
    yield ""
    yield "```sh"
    yield "rsltrace record job.yaml -o again.mcap"
    yield f"# digest {failing.digest}  events {failing.events}"
    if failing.failure.event is not None:
        yield f"rsltrace view failing.mcap --at {failing.failure.event}"
        yield f"rsltrace debug failing.mcap  # then: goto {failing.failure.event}"
    if passing is not None:
        yield "rsltrace diff passing.mcap failing.mcap"
    yield "```"
    yield ""
    yield "Besides the job, this run needs the following to fail:"
    yield ""
    needed = list(_needed(reduced))
    yield from needed or ["- nothing: the job fails as it is"]
    yield ""
    if not reduced.is_minimal:
        yield f"(It may need less: the reduction stopped after {reduced.runs} runs.)"
    else:
        yield f"None of it can be left out alone ({reduced.runs} runs were tried)."
    yield ""
    if passing is not None:
        yield f"`passing.mcap` is the nearest run that passes: {printable(reduced.passing_words)}."
        yield "`passing.yaml` repeats it."
        yield "`diff.txt` shows where the two diverge."
    else:
        yield "No run with one part less passes, so there is no `passing.mcap`."
    yield ""
    yield "`test_reproduces.py` is a test for pytest. The folder can be moved together with the"
    yield "sources that `job.yaml` names."


def _needed(reduced: ReducedTrial) -> Iterator[str]:
    parts = reduced.parts
    if parts.seed is not None:
        yield f"- seed {parts.seed}"
    for name, value in parts.settings:
        yield f"- {printable(f'{name} = {value}')}"
    for one, names in zip(parts.departures or (), reduced.chosen, strict=True):
        what = f": {printable(names)}" if names else ""
        yield f"- a different order at choice {one['choice']} (ready entity {one['run']}){what}"
    for fault in parts.faults or ():
        words = ", ".join(f"{key}: {value}" for key, value in fault.items())
        yield f"- the fault {{{printable(words)}}}"
    if parts.until_ns is not None:
        yield f"- it may end at {format_seconds(parts.until_ns)} s"
    if reduced.left_out:
        yield f"- it needs no {printable(', '.join(reduced.left_out))}"


def _one_line(result: TrialResult) -> str:
    assert result.failure is not None
    return printable(result.failure.text.splitlines()[0]).rstrip(".") + "."


JOB, FAILING, PASSING, DIFF = "job.yaml", "failing.mcap", "passing.mcap", "diff.txt"
PASSING_JOB = "passing.yaml"
README, TEST = "README.md", "test_reproduces.py"
_OF_FOLDER = re.compile(r"[^\s()]*/((?:failing|passing)\.mcap)")


def write_small(
    source: JobSource, reduced: ReducedTrial, folder: Path, *, timeout_s: float | None = None
) -> str:
    """Write a reduced trial to ``folder``; return a sentence on where it diverges from the nearest
    passing run, "" if there is none.

    The job in the folder is the job with the trial's changes; its paths are relative to the folder.
    The failing trace is recorded from that file.

    :raises ExploreError: that run is a different one, or the folder cannot be written.
    """
    folder = folder.resolve()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return _write(source, reduced, folder, timeout_s)
    except OSError as error:
        raise ExploreError(f"{error.filename or folder}: {error.strerror}") from None


def _write(source: JobSource, reduced: ReducedTrial, folder: Path, timeout_s: float | None) -> str:
    job = moved_job(source, reduced.parts, folder)
    _put(folder / JOB, job.to_yaml())
    failing = _recorded(JobSource(str(folder / JOB)), job, folder / FAILING, timeout_s)
    if failing.digest != reduced.result.digest and not _is_moved(job, failing, reduced.result):
        raise ExploreError(
            f"{folder / JOB} does not repeat the trial (digest {failing.digest}, not "
            f"{reduced.result.digest}): they differ in something outside of the job"
        )
    passing, decides = None, ""
    for name in (PASSING, PASSING_JOB, DIFF):
        (folder / name).unlink(missing_ok=True)  # of an earlier one
    if reduced.passing is not None:
        _put(folder / PASSING_JOB, moved_job(source, reduced.passing, folder).to_yaml())
        passing = _recorded(JobSource(str(folder / PASSING_JOB)), job, folder / PASSING, timeout_s)
        report, decides = _diff(folder)
        _put(folder / DIFF, report)
    _put(folder / TEST, test_module(failing))
    _put(folder / README, readme(reduced, failing, passing))
    return decides


def _is_moved(job: Job, failing: TrialResult, before: TrialResult) -> bool:
    """Whether two runs fail alike and may differ only in the paths of programs, which their events
    name."""
    if failing.failure is None or before.failure is None:
        return False
    names_files = any(spec.script or spec.program for spec in job.nodes)
    same = (failing.failure.kind, failing.events) == (before.failure.kind, before.events)
    return names_files and same


def moved_job(source: JobSource, parts: OverlayParts, folder: Path) -> Job:
    """Return the job of a trial with paths relative to ``folder``. Raises JobError."""
    trial = Trial(0, parts.overlay())
    own = [*source.overrides, *source.overrides_of(trial)]
    name = str(folder / JOB)
    if source.text is not None:  # there is no file: the overrides have everything else
        before = source.job()
        paths = [os.path.relpath(before.resolve(path)) for path in before.search_path]
        own.append(("--set", f"search_path={json.dumps(paths)}"))
        return job_from_text(source.text, name, folder, overrides=own)
    original = os.path.abspath(source.path)
    base = json.dumps({"base": os.path.relpath(original, folder)})
    before = load_job(original, overrides=source.overrides)
    moved = list(_moved_arguments(before, folder))
    return job_from_text(base, name, folder, overrides=[*own, *moved])


def _moved_arguments(job: Job, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield overrides for the paths among a job's ROS arguments, which are words like others."""
    for index, word in enumerate(job.ros_arguments[1:], start=1):
        if job.ros_arguments[index - 1] == "--params-file":
            path = os.path.relpath(job.resolve(word), folder)
            yield "--params-file", f"ros_arguments.{index}={json.dumps(path)}"


def _recorded(source: JobSource, job: Job, path: Path, timeout_s: float | None) -> TrialResult:
    """Run the job of a file; its trace is at ``path`` afterwards."""
    path.unlink(missing_ok=True)
    with Worker(source, pins=job.guard.pins) as worker:
        return worker.run(Trial(0, {}), path, TrialOptions(keep=True), timeout_s)


def _diff(folder: Path) -> tuple[str, str]:
    """Return what differs between the two traces, named as in the folder: all, and a sentence."""
    from rsltrace.diff import diff_files
    from rsltrace.diff.options import DiffOptions
    from rsltrace.diff.report import render

    found: Any = diff_files(folder / PASSING, folder / FAILING)
    text: str = render(found, "text", DiffOptions())
    return _OF_FOLDER.sub(r"\1", text), found.sentence


def _put(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


_CAUSES_MAX = 10


@dataclass(frozen=True, slots=True)
class ReducedFailure:
    """A reduced cause of failures: its folder, and the one difference that decides (empty if there
    is none). ``trouble`` says why there is no folder."""

    folder: Path
    decides: str = ""
    trouble: str = ""


def reduce_failures(
    source: JobSource,
    first: Mapping[str, TrialResult],
    folder: Path,
    *,
    pins: bool = True,
    timeout_s: float | None = None,
    on_begin: Callable[[str], None] = lambda cause: None,
) -> dict[str, ReducedFailure]:
    """Reduce the first run of each cause, each to a folder in ``folder`` of the search.

    ``on_begin`` receives the key of the cause that is next.
    """
    found = {}
    by_number = sorted(first.items(), key=lambda item: item[1].trial.number)
    for key, result in by_number[:_CAUSES_MAX]:
        on_begin(key)
        place = folder / SMALL / f"{result.trial.number:06d}"
        try:
            with (
                tempfile.TemporaryDirectory(dir=folder) as scratch,
                Worker(source, pins=pins) as worker,
            ):
                reduced = TrialReduction(
                    source, result, worker, Path(scratch), timeout_s=timeout_s
                ).reduce()
                decides = write_small(source, reduced, place, timeout_s=timeout_s)
            found[key] = ReducedFailure(place, decides)
        except ExploreError as error:
            found[key] = ReducedFailure(place, trouble=str(error))
        except OSError as error:
            found[key] = ReducedFailure(place, trouble=f"{error.filename}: {error.strerror}")
    return found
