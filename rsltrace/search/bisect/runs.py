"""Run a job at a revision: in a process with the code of the worktree, and judge the run."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rsltrace.child_processes import OWN_FOLDER, Processes, rsltrace_command
from rsltrace.conditions.run_expression import RunExpression
from rsltrace.errors import BisectError, ConditionError
from rsltrace.search.bisect.repository import GitRepository, Worktree
from rsltrace.search.perturb import (
    Perturbation,
    PerturbedRun,
    can_fix_addresses,
    perturbed_run,
    record_words,
)
from rsltrace.terminal import tell
from rsltrace.trace.reader import Trace

Judge = Callable[[Path, Path], bool]
"""Takes a trace and the folder of its run. Raises BisectError if it cannot decide."""

_TARGET = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_SKIP = 125
"""The exit status with which ``git bisect run`` skips a revision."""


@dataclass(frozen=True, slots=True)
class RevisionCheck:
    """How a run is judged; ``words`` name it in messages."""

    words: str
    judge: Judge


def expression_check(text: str) -> RevisionCheck:
    """Return the check of ``--check``: an expression, or ``module:function`` of a ``Trace``.

    :raises BisectError: it is neither.
    :raises JobError: there is no such function.
    """
    if not _TARGET.fullmatch(text.strip()):
        try:
            expression = RunExpression(text)
        except ConditionError as error:
            raise BisectError(f"--check: {error}") from None

        def judge(path: Path, folder: Path) -> bool:
            with Trace.open(path) as trace:
                try:
                    return bool(expression.value(trace))
                except ConditionError as error:
                    raise BisectError(f"--check {text!r}: {error.message}") from None

        return RevisionCheck(expression.text, judge)
    from rsltrace.run.plans.scheduling import load_target

    sys.path.insert(0, str(Path.cwd()))
    function = load_target(text.strip(), where="--check")

    def call(path: Path, folder: Path) -> bool:
        with Trace.open(path) as trace:
            try:
                return bool(function(trace))
            except Exception as error:
                said = f"{type(error).__name__}: {error}"
                raise BisectError(f"--check {text} has no answer there: {said}") from error

    return RevisionCheck(text.strip(), call)


def command_check(words: str, processes: Processes) -> RevisionCheck:
    """Return the check of ``--run``: a shell command, judged as ``git bisect run`` does.

    It runs where the run did, with the path of the run's trace in ``RSLTRACE_TRACE``.
    """

    def judge(path: Path, folder: Path) -> bool:
        env = {**os.environ, "RSLTRACE_TRACE": str(path)}
        done = processes.run(["/bin/sh", "-c", words], cwd=folder, env=env)
        tell(done.output + done.errors, end="")
        if not 0 <= done.exit_code < 128 or done.exit_code == _SKIP:
            raise BisectError(f"--run {words!r} ended with exit status {done.exit_code}")
        return done.exit_code == 0

    return RevisionCheck(words, judge)


@dataclass(frozen=True, slots=True)
class RevisionRunner:
    """Runs a job in a worktree; ``arguments`` are those of ``rsltrace record``, paths in it."""

    repository: GitRepository
    worktree: Worktree
    arguments: tuple[str, ...]
    processes: Processes
    timeout_s: float | None = None

    def run(self, name: str) -> PerturbedRun:
        """Run the revision in the worktree; its trace is ``name``.mcap."""
        cwd = self.folder
        cwd.mkdir(parents=True, exist_ok=True)
        path = self.worktree.folder / f"{name}.mcap"
        command = rsltrace_command(record_words(self.arguments, path))
        if can_fix_addresses():
            command = ["setarch", "-R", *command]
        done = self.processes.run(
            command, cwd=cwd, env=self._environment(), timeout_s=self.timeout_s
        )
        return perturbed_run(Perturbation(0, {}), path, done)

    @property
    def folder(self) -> Path:
        """The working directory, in the worktree or as seen from there."""
        return self.worktree.path(Path.cwd())

    def _environment(self) -> Mapping[str, str]:
        given = os.environ.get("PYTHONPATH")
        folders = map(str, map(self.worktree.path, python_folders(self.repository)))
        path = [*folders, *([given] if given else [])]
        return {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(path),
            "PYTHONHASHSEED": "0",
            # Two versions of a source with the same size and second would share bytecode.
            "PYTHONDONTWRITEBYTECODE": "1",
        }


def python_folders(repository: GitRepository) -> list[Path]:
    """Return the checkout's folders on Python's path, also of packages installed in place
    (``pip install -e``). A revision's own folders replace them."""
    found = []
    for entry in dict.fromkeys([*sys.path, *_known_to_finders()]):
        path = Path(entry or ".").resolve()
        if path == OWN_FOLDER or not path.is_relative_to(repository.top):
            continue  # rsltrace itself is the same at every revision
        if not path.is_relative_to(Path(sys.prefix).resolve()) and repository.has_tracked(path):
            found.append(path)
    return found


def _known_to_finders() -> Iterator[str]:
    """Yield the folders of packages that only setuptools' finders know."""
    for finder in sys.meta_path:
        module = sys.modules.get(getattr(finder, "__module__", ""))
        for place in getattr(module, "MAPPING", {}).values():
            yield os.path.dirname(place)
