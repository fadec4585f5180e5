"""The folder of a failing run: everything that somebody else needs to see it fail."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rsltrace.errors import ExploreError
from rsltrace.job import Job, job_from_text, load_job
from rsltrace.search.explore.outcome import Wants
from rsltrace.search.explore.small.documents import readme, test_module
from rsltrace.search.explore.small.reduction import Parts, Reduced
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult, overrides_of
from rsltrace.search.explore.workers import Worker

JOB, FAILING, PASSING, DIFF = "job.yaml", "failing.mcap", "passing.mcap", "diff.txt"
README, TEST = "README.md", "test_reproduces.py"
_OF_FOLDER = re.compile(r"[^\s()]*/((?:failing|passing)\.mcap)")


def write_small(
    source: JobSource, reduced: Reduced, folder: Path, *, timeout_s: float | None = None
) -> str:
    """Write a reduced trial to ``folder``, which is made; return in a sentence where it parts from
    the nearest run that passes, "" if there is none.

    The job in it is the whole job with what sets the trial apart, and names the same sources, bags
    and files as the original, relative to the folder. Its run has been made from that very file.

    :raises ExploreError: the run from there is another one, or the folder cannot be written.
    """
    folder = folder.resolve()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return _write(source, reduced, folder, timeout_s)
    except OSError as error:
        raise ExploreError(f"{error.filename or folder}: {error.strerror}") from None


def _write(source: JobSource, reduced: Reduced, folder: Path, timeout_s: float | None) -> str:
    job = moved_job(source, reduced.parts, folder)
    _put(folder / JOB, job.to_yaml())
    failing = _recorded(JobSource(str(folder / JOB)), job, folder / FAILING, timeout_s)
    if failing.digest != reduced.result.digest:
        raise ExploreError(
            f"{folder / JOB} does not do what the trial did (digest {failing.digest}, not "
            f"{reduced.result.digest}): what differs is not in the job"
        )
    passing, decides = None, ""
    for name in (PASSING, DIFF):
        (folder / name).unlink(missing_ok=True)  # of an earlier one
    if reduced.passing is not None:
        text = moved_job(source, reduced.passing, folder).to_yaml()
        passing_source = JobSource(str(folder / JOB), (), text, str(folder))
        passing = _recorded(passing_source, job, folder / PASSING, timeout_s)
        report, decides = _diff(folder)
        _put(folder / DIFF, report)
    _put(folder / TEST, test_module(failing))
    _put(folder / README, readme(reduced, failing, passing))
    return decides


def moved_job(source: JobSource, parts: Parts, folder: Path) -> Job:
    """Return the job of a trial as one whose file is in ``folder``: paths in it start there.

    :raises JobError: it is wrong.
    """
    trial = Trial(0, parts.overlay())
    own = [*source.overrides, *overrides_of(trial)]
    name = str(folder / JOB)
    if source.text is not None:  # there is no file: what it is stands in the overrides
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
        return worker.run(Trial(0, {}), path, Wants(keep=True), timeout_s)


def _diff(folder: Path) -> tuple[str, str]:
    """Return what differs between the two traces, named as in the folder: all, and a sentence."""
    from rsltrace.diff import diff_files
    from rsltrace.diff.options import DiffOptions
    from rsltrace.diff.report import render

    found: Any = diff_files(folder / FAILING, folder / PASSING)
    text: str = render(found, "text", DiffOptions())
    return _OF_FOLDER.sub(r"\1", text), found.sentence


def _put(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
