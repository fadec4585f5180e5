"""A line for each run of a suite, appended to a file or put into a folder or a bucket.

Lines are JSON, so histories are joined by ``cat`` and read by any tool. One file for all runs is
locked while a line is written. Buckets have no appending: there, as in a local folder, each run has
a file of its own. Rejected: Parquet (a file of one row is ten times as large, and cannot grow).
"""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from rsltrace.errors import OutputError, RsltraceError, SetupError, TraceError
from rsltrace.search.bisect.repository import git
from rsltrace.terminal import tell
from rsltrace.trace.mcap.remote import filesystem_of
from rsltrace.trace.mcap.source import public_address, redacted
from rsltrace.trace.model.regular_file import not_replaceable
from rsltrace.trace.model.texts import printable, shortened

if sys.platform != "win32":
    import fcntl

SUFFIX = ".jsonl"
DIRTY = "-dirty"
"""Follows a commit whose tracked files were changed, as ``git describe --dirty`` has it."""
_TEXT_MAX = 2000
_COMMITS = ("GITHUB_SHA", "CI_COMMIT_SHA")
_BRANCHES = ("GITHUB_HEAD_REF", "GITHUB_REF_NAME", "CI_COMMIT_REF_NAME")

_Time = Annotated[str, Field(pattern=r"^[0-9]{4}-[01][0-9]-[0-3][0-9]T[0-9:]{8}\.[0-9]{3}Z$")]
_Digest = Annotated[str, Field(pattern="^([0-9a-f]{16})?$")]
_Count = Annotated[int, Field(ge=0, lt=1 << 62)]


@dataclass(slots=True)
class RunRecord:
    """A line: the run of a command (``by``) that ended at ``time``.

    ``commit`` and ``branch`` are empty if unknown. ``reason`` is the first divergence, the most
    frequent cause of failures, or the error. ``runs`` are the runs of a search, ``failed`` those
    that failed. The command sets the result while it runs.
    """

    time: _Time
    by: str
    job: str
    commit: str = ""
    branch: str = ""
    digest: _Digest = ""
    verdict: Literal["passed", "failed", "error"] = "passed"
    reason: str = ""
    seconds: Annotated[float, Field(ge=0, lt=1e12)] | None = None
    runs: _Count = 1
    failed: _Count = 0

    def fails(self, reason: str) -> None:
        """Set the verdict of a run that fails."""
        self.verdict, self.reason = "failed", reason


READER: TypeAdapter[RunRecord] = TypeAdapter(RunRecord)
"""Checks the types of a line; keys that it does not know are those of a later version."""


Arguments = Callable[[Callable[[str], object]], Sequence[str]]
"""Returns the words that name a job, with its paths converted."""


@contextmanager
def recorded(place: str | None, by: str, file: Path, arguments: Arguments) -> Iterator[RunRecord]:
    """Give the record of a run, and append it to the history at ``place`` (None: to none) when the
    block ends, or ends with an RsltraceError or a failed assertion.

    The job has the name of its ``arguments``, with paths relative to the repository of ``file``.

    :raises OutputError: ``place`` cannot be written.
    """
    if not place:
        yield RunRecord("", by, "")
        return
    if "://" not in place and not _is_folder(place):
        _append(Path(place), b"")  # before the run, which may take long
    elif "://" in place:
        if place.endswith(SUFFIX):
            name = public_address(place)
            raise OutputError(f"the history {name} is no folder: each run gets a file there")
        _filesystem(place)
    folder = file.parent.absolute()
    commit, branch, top = _origin(next(one for one in (folder, *folder.parents) if one.is_dir()))

    def relative(path: str) -> str:
        if "://" in path:
            return public_address(path)
        folder, name = os.path.split(path)  # git resolves links of folders
        found = os.path.relpath(os.path.join(os.path.realpath(folder), name), top)
        return found.replace(os.sep, "/")

    record = RunRecord("", by, shlex.join(arguments(relative)), commit, branch)
    begin = time.monotonic()
    try:
        yield record
    except (RsltraceError, AssertionError) as error:
        if record.verdict == "passed":
            record.verdict, record.reason = "error", str(error)
        try:
            _write(place, record, begin)
        except OutputError as trouble:
            tell(f"rsltrace: warning: {trouble}")
        raise
    if record.runs:
        _write(place, record, begin)


def _write(place: str, record: RunRecord, begin: float) -> None:
    now = datetime.now(timezone.utc)
    record.time = f"{now:%Y-%m-%dT%H:%M:%S}.{now.microsecond // 1000:03d}Z"
    record.seconds = round(time.monotonic() - begin, 3)
    record.reason = shortened(printable(record.reason.partition("\n")[0]), _TEXT_MAX)
    record.job, record.branch = (
        shortened(printable(text), _TEXT_MAX) for text in (record.job, record.branch)
    )
    line = json.dumps(asdict(record), separators=(",", ":")).encode() + b"\n"
    name = f"{now:%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:12]}{SUFFIX}"
    if "://" in place:
        _put(f"{place.rstrip('/')}/{name}", line)
    else:
        _append(Path(place, name) if _is_folder(place) else Path(place), line)


def _is_folder(place: str) -> bool:
    return place.endswith("/") or Path(place).is_dir()


def _append(path: Path, line: bytes) -> None:
    """Append a line. What a process that was killed has left of one is ended first."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind := not_replaceable(path):
            raise OSError(0, f"it is {kind}")
        fd = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
        with open(fd, "r+b", buffering=0) as file:
            if sys.platform != "win32":
                with suppress(OSError):  # some file systems have no locks
                    fcntl.flock(fd, fcntl.LOCK_EX)
            size = file.seek(0, os.SEEK_END)
            if size and line:
                file.seek(size - 1)
                line = line if file.read(1) == b"\n" else b"\n" + line
            if file.write(line) != len(line):
                file.truncate(size)
                raise OSError(0, "no space is left")
    except OSError as error:
        raise OutputError(f"the history {path} cannot be written: {error.strerror}") from None


def _put(address: str, line: bytes) -> None:
    filesystem, path = _filesystem(address)
    try:
        filesystem.pipe_file(path, line)
    except Exception as error:  # whatever the storage's library raises: there are many
        reason = redacted(str(error) or type(error).__name__, address)
        name = public_address(address)
        raise OutputError(f"the history {name} cannot be written: {reason}") from None


def _filesystem(address: str) -> tuple[Any, str]:
    try:
        return filesystem_of(address)
    except (SetupError, TraceError) as error:
        raise OutputError(f"the history cannot be written: {error}") from None


def _origin(folder: Path) -> tuple[str, str, str]:
    """Return commit, branch and top folder of a job's repository; without one, what CI says, and
    the working directory."""
    commit, branch, top = _variable(_COMMITS), "", os.path.realpath(os.curdir)
    words = ("--no-optional-locks", "status", "--porcelain=v2", "--branch", "--untracked-files=no")
    try:
        status = git(folder, *words).output.splitlines()
        top = git(folder, "rev-parse", "--show-toplevel").output.rstrip("\n")
    except (RsltraceError, OSError):
        status = []
    head: dict[str, str] = {}
    is_dirty = False
    for line in status:
        if line.startswith("# "):  # "# stash 1" if status.showStash is set
            key, _, value = line.removeprefix("# branch.").partition(" ")
            head[key] = value
        else:
            is_dirty = True
    oid = head.get("oid", "(")
    if not oid.startswith("("):  # (initial)
        commit = oid + DIRTY * is_dirty
    if not head.get("head", "(").startswith("("):  # (detached)
        branch = head["head"]
    return commit, _variable(_BRANCHES) or branch, top


def _variable(names: tuple[str, ...]) -> str:
    return next(filter(None, (os.environ.get(name) for name in names)), "")
