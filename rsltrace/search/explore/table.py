"""The results of a search: a folder with a row for each finished run, safe against kills.

search.json      what is searched, and how
results.jsonl    a row for each trial, in the order in which they ended
learned.jsonl    what the strategy has to remember of some runs
traces/          the traces of runs that failed: those of the lowest numbers of each cause

A trace that a row names may be displaced by that of an earlier trial which ends later. Reading the
rows finds the traces that still exist.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from rsltrace.errors import ExploreError
from rsltrace.search.explore.trial import TrialResult, result_of
from rsltrace.trace.model.regular_file import read_regular, replacement_of

RESULTS, SEARCH, LEARNED, TRACES = "results.jsonl", "search.json", "learned.jsonl", "traces"
PAGE, PARQUET, SMALL = "report.html", "results.parquet", "small"


class ResultsFolder:
    """A folder that results are written to. A context manager.

    :raises ExploreError: on entering, if there is a search in the folder that is not to be resumed,
        or is another one, or if it cannot be written to.
    """

    def __init__(
        self, folder: Path, about: Mapping[str, Any], *, resume: bool, force: bool = False
    ) -> None:
        """``about`` are JSON values that say what is searched; to resume they must be the same.
        ``force`` deletes the search that is in the folder."""
        self.folder = folder
        self.earlier: list[TrialResult] = []
        """The results that were there, of a search that is resumed."""
        self.learned: list[TrialResult] = []
        """What had to be kept of some of them."""
        self._about = dict(about)
        self._resume = resume
        self._force = force
        self._files: dict[str, int] = {}

    def __enter__(self) -> ResultsFolder:
        try:
            (self.folder / TRACES).mkdir(parents=True, exist_ok=True)
            self._check()
            self.earlier = _whole_rows(self.folder / RESULTS)
            done = {one.trial.number for one in self.earlier}
            learned = _whole_rows(self.folder / LEARNED)
            self.learned = [one for one in learned if one.trial.number in done]
            if not (self.folder / SEARCH).exists():
                _replace(self.folder / SEARCH, json.dumps(self._about, indent=1) + "\n")
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
            for name in (LEARNED, RESULTS):
                self._files[name] = os.open(self.folder / name, flags, 0o666)
        except OSError as error:
            raise _cannot_write(self.folder, error, "name another folder with -o") from None
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._files.values():
            with suppress(OSError):
                os.fsync(file)
            os.close(file)
        self._files.clear()

    def trace_of(self, number: int) -> Path:
        """Return where the trace of a trial goes."""
        return _trace_of(self.folder, number)

    def add(self, result: TrialResult, learned: TrialResult | None = None) -> None:
        """Append a row, and what the strategy has to remember.

        :raises ExploreError: it cannot be written; the rows before it are whole.
        """
        if learned is not None:
            self._append(LEARNED, learned.as_values())
        self._append(RESULTS, result.row())

    def _append(self, name: str, values: Mapping[str, Any]) -> None:
        line = json.dumps(values, separators=(",", ":")).encode() + b"\n"
        file = self._files[name]
        size = os.fstat(file).st_size
        try:
            if os.write(file, line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder / name))
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(file, size)
            kept = f"the results so far are kept in {self.folder}, --resume continues"
            raise _cannot_write(self.folder, error, kept) from None

    def _check(self) -> None:
        there = self.folder / SEARCH
        if not there.exists():
            if self._resume:
                raise ExploreError(f"{self.folder}: there is no search to resume")
            return
        if self._force:
            self._delete()
            return
        if not self._resume:
            raise ExploreError(
                f"{self.folder} has the results of a search: --resume continues it, --force "
                "replaces it, -o names another folder"
            )
        try:
            about = json.loads(read_regular(there))
        except ValueError:
            raise ExploreError(f"{there} was not written by rsltrace explore") from None
        for key, value in self._about.items():
            if about.get(key) != value:
                raise ExploreError(
                    f"{self.folder} has a different search ({key} differs); choose another folder "
                    "with -o"
                )

    def _delete(self) -> None:
        """Delete the search in the folder; what else lies there stays."""
        for name in (TRACES, SMALL):
            with suppress(FileNotFoundError):
                shutil.rmtree(self.folder / name)
        (self.folder / TRACES).mkdir()
        for name in (RESULTS, LEARNED, PAGE, PARQUET, SEARCH):
            (self.folder / name).unlink(missing_ok=True)


def result_rows(folder: Path) -> Iterator[TrialResult]:
    """Yield the results in a folder.

    :raises ExploreError: there are none, or they cannot be read.
    """
    try:
        yield from _read(folder / RESULTS)
    except FileNotFoundError:
        raise ExploreError(f"{folder} has no {RESULTS}: it is not the folder of a search") from None
    except OSError as error:
        raise ExploreError(f"{folder / RESULTS} cannot be read: {error.strerror}") from None


def _read(path: Path) -> Iterator[TrialResult]:
    for number, line in enumerate(read_regular(path).splitlines(keepends=True), 1):
        if not line.endswith(b"\n"):
            return  # cut off while it was written
        try:
            found = result_of(json.loads(line))
        except (ValueError, KeyError, TypeError):
            raise ExploreError(f"{path}:{number} is not a row of a search") from None
        trace = _trace_of(path.parent, found.trial.number)
        yield found if found.trace is None else replace(found, trace=_if_there(trace))


def _trace_of(folder: Path, number: int) -> Path:
    return folder / TRACES / f"{number:06d}.mcap"


def _if_there(trace: Path) -> str | None:
    return str(trace) if trace.is_file() else None


def _whole_rows(path: Path) -> list[TrialResult]:
    """Return the rows, and take away the end of one that a kill has cut off."""
    if not path.exists():
        return []
    data = read_regular(path)
    whole = data.rfind(b"\n") + 1
    if whole != len(data):
        os.truncate(path, whole)
    return list(_read(path))


def _replace(path: Path, text: str) -> None:
    with replacement_of(path) as work:
        work.write_text(text)


def _cannot_write(folder: Path, error: OSError, next_step: str) -> ExploreError:
    of = error.filename or folder
    return ExploreError(f"{of} cannot be written: {error.strerror}; {next_step}")
