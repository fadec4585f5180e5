"""The folder of a trace's job. A trace holds no absolute paths, so the folder is looked for."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rsltrace.errors import JobError, ReplayError
from rsltrace.job import Job
from rsltrace.job.reading.resolved import job_from_resolved
from rsltrace.replay.code import file_of
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.reader import Trace

_NAME_MAX = 255
"""Bytes that the name of a file can have."""


def without_bags(load: Callable[[tuple[str, ...]], Job]) -> Job:
    """Return a job without its bags, which need not be there. ``load`` gets overrides.

    :raises JobError: if it cannot be used otherwise.
    """
    try:
        return load(("bags=[]",))
    except JobError as error:
        try:
            return load(("bags=[]", "progress=null"))  # who has no bags has no progress
        except JobError:
            raise error from None


def job_in_trace(trace: Trace, folder: Path, *, bags: bool = True) -> Job:
    """Return the job that a trace holds, as if its file were in ``folder``. Nothing is run.

    Without ``bags`` it is that job without them, and they need not be there.

    :raises ReplayError: if the trace holds none, or one of another version.
    """
    try:
        resolved = _resolved(trace)
        _let_follow(trace, resolved, folder)
        if not bags:
            resolved.update(bags=[], progress=None)
        return job_from_resolved(
            resolved, name=job_name(trace), text=trace.job_text, folder=folder.absolute()
        )
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ReplayError(f"the job in {trace.name} cannot be read: {error}") from error
    except JobError as error:
        raise ReplayError(
            f"the job in {trace.name} cannot be run in {folder}: {error}; the folder of the job "
            "file is named with --job-folder DIR"
        ) from error


def _resolved(trace: Trace) -> dict[str, Any]:
    try:
        resolved = json.loads(trace.job.get("resolved") or "null")
    except (ValueError, RecursionError) as error:
        raise ReplayError(f"the job in {trace.name} cannot be read: {error}") from error
    if not isinstance(resolved, dict):
        raise ReplayError(f"{trace.name} does not hold the job that was run: nothing to replay")
    return resolved


def _let_follow(trace: Trace, resolved: dict[str, Any], folder: Path) -> None:
    """Let a job that followed a recording which is gone follow the trace: it has that order."""
    policy = resolved.get("policy")
    if not isinstance(policy, dict) or not isinstance(policy.get("recorded"), str):
        return
    if not (folder / policy["recorded"]).is_file():
        policy["recorded"] = str(Path(trace.name).resolve())


def job_name(trace: Trace) -> str:
    """Return the name of the file that a trace's job was read from, empty if it was none."""
    name = Path(trace.job.get("name", "")).name
    return "" if name == "<python>" or len(name.encode("utf-8", "replace")) > _NAME_MAX else name


def folder_of(trace: Trace, given: Path | None) -> Path:
    """Return the folder of a trace's job: the one that is given, or one in which the job is.

    :raises ReplayError: saying what was looked for, and where.
    """
    if given is not None:
        if not given.is_dir():
            raise ReplayError(f"--job-folder {given}: there is no such folder")
        return given
    beside = [] if "://" in trace.name else [Path(trace.name).parent]
    places = list(dict.fromkeys([*beside, Path()]))
    wanted = _wanted(trace)
    best = max(places, key=lambda place: _found(trace, place, wanted))
    if _found(trace, best, wanted)[0] or not wanted:
        return best
    listed = ", ".join(wanted[:5]) + (f" and {len(wanted) - 5} more" if len(wanted) > 5 else "")
    where = " and in ".join(_shown(place) for place in places)
    raise ReplayError(
        f"the job of {trace.name} is not here: looked for {listed} in {where}; name the folder "
        "that the job file is in with --job-folder DIR"
    )


def _shown(place: Path) -> str:
    return "the present folder" if place == Path() else str(place)


def _wanted(trace: Trace) -> list[str]:
    """Return what shows that a folder is the job's: its file, or else the modules of its nodes."""
    if job_name(trace):
        return [job_name(trace)]
    return [name for name in trace.metadata(METADATA_SOURCES) if not name.startswith("file:")]


def _found(trace: Trace, folder: Path, wanted: Sequence[str]) -> tuple[bool, bool]:
    """Say whether a folder has what is wanted, and whether the job file says what it said."""
    if not job_name(trace):
        folders = _search(trace, folder)
        return all(file_of(name, folders, installed=False) for name in wanted), False
    file = folder / job_name(trace)
    return file.is_file(), file.is_file() and _text(file) == trace.job_text


def _search(trace: Trace, folder: Path) -> list[str]:
    listed = _resolved(trace).get("search_path")
    return [str(folder / str(path)) for path in (listed if isinstance(listed, list) else ["."])]


def _text(file: Path) -> str:
    try:
        return file.read_bytes().decode("utf-8-sig", "replace")
    except OSError:
        return ""
