"""Branches of a debugging session: its run, repeated with edits.

A branch is a trace, so a session continues in it as in any other.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rsltrace.child_processes import Done, Processes, rsltrace_command
from rsltrace.errors import DebugError, EditError, OutputError
from rsltrace.replay.edits import parse_edit
from rsltrace.trace.model.regular_file import not_replaceable

_ERROR = "rsltrace: error: "
_HAS_PLACE = re.compile(r"\s*(t=)?@?[0-9][^:\"'(]*:")


class EditBranches:
    """Branches of the run of a trace or job. ``path`` is the trace of the last one."""

    def __init__(
        self, source: str | Path, job_folder: str | Path | None, overrides: Sequence[str]
    ) -> None:
        self.path: Path | None = None
        self._source = Path(source)
        self._job_folder = job_folder
        self._overrides = overrides
        self._count = 0
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self._processes = Processes()

    @property
    def job_folder(self) -> str:
        """The folder of the job; known once a branch exists."""
        return str(self._job_folder)

    def close(self) -> None:
        self._processes.kill()
        if self._temporary is not None:
            self._temporary.cleanup()

    def make(self, text: str, index: int) -> Path:
        """Branch off with one more edit, which is at ``index`` if its text says no place.

        :raises EditError: it is none, or cannot be made.
        :raises DebugError: there is no run to branch off.
        """
        edit = parse_edit(text if _HAS_PLACE.match(text) else f"{index}: {text}").text
        folder = self._folder()
        before = self.path or self._first(folder)
        self._count += 1
        path = folder / f"branch-{self._count}.mcap"
        words = ["replay", str(before), "--edit", edit, "-o", str(path), "--trust", "--quiet"]
        done = self._run([*words, "--json", "--job-folder", str(self._job_folder)])
        try:
            result = json.loads(done.output)
            edits, path_made = result["edits"], result["path"]
        except (ValueError, KeyError, TypeError):
            raise EditError(_said(done)) from None
        if edit not in edits or path_made is None or done.exit_code not in (0, 1):
            raise DebugError(f"there is no branch: {result.get('ended')}")
        self.path = path
        return path

    def keep(self, output: str | Path, *, force: bool) -> Path:
        """Copy the trace of the last branch.

        :raises DebugError: there is none.
        :raises OutputError: the file exists, or cannot be written.
        """
        if self.path is None:
            raise DebugError("nothing has been edited in this session, so there is no branch")
        place = Path(output)
        if kind := not_replaceable(place):
            raise OutputError(f"{place} is {kind}; name a file, or remove it")
        if place.exists() and not force:
            raise OutputError(f"{place} exists; force=True replaces it")
        part = place.with_name(f".{place.name}.{os.getpid()}")
        try:
            shutil.copyfile(self.path, part)
            part.replace(place)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise OutputError(f"{place} cannot be written: {error.strerror}") from error
        return place

    def _folder(self) -> Path:
        if self._temporary is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="rsltrace-branches-")
        return Path(self._temporary.name)

    def _first(self, folder: Path) -> Path:
        """Return the trace to branch from: the session's, or a recording of its job."""
        from rsltrace.diff.file_kind import is_trace

        if is_trace(os.fspath(self._source)):
            if self._job_folder is None:
                from rsltrace.replay.preparation import job_folder_of
                from rsltrace.trace.reader import Trace

                with Trace.open(self._source) as trace:
                    self._job_folder = job_folder_of(trace, None).absolute()
            return self._source
        self._job_folder = self._source.parent.absolute()
        path = folder / "run.mcap"
        words = ["record", str(self._source), "-o", str(path), "--quiet", "--json", "--force"]
        for override in self._overrides:
            words += ["--set", override]
        done = self._run(words)
        if not path.is_file():
            raise DebugError(_said(done))
        return path

    def _run(self, words: Sequence[str]) -> Done:
        return self._processes.run(rsltrace_command(words), cwd=Path.cwd(), env=os.environ)


def _said(done: Done) -> str:
    """Return the error message of a failed command."""
    before, error, message = done.errors.partition(_ERROR)
    return (message if error else before).strip() or f"it ended with status {done.exit_code}"
