"""Bisect: run both ends, then the revisions between them that ``git bisect`` chooses, each in a
process with the code of the worktree, and judge the runs."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

from rsltrace.checks.conditions.run_expression import RunExpression
from rsltrace.child_processes import OWN_FOLDER, Processes, rsltrace_command
from rsltrace.errors import BisectError, ConditionError
from rsltrace.search.bisect.repository import Commit, GitRepository, Worktree
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


_FIRST = re.compile(r"^([0-9a-f]{40,64}) is the first bad commit$", re.MULTILINE)
_COMMIT = re.compile("[0-9a-f]{40,64}")
_ANY_OF = "The first bad commit could be any of:"
_LEFT = re.compile(r"^Bisecting: (\d+) revisions? left .*\(roughly (\d+) steps?\)", re.MULTILINE)
_ERROR = "rsltrace: error: "
_TIMEOUT_MIN_S = 120.0
_TIMEOUT_FACTOR = 30


class RevisionVerdict(Enum):
    """A revision's verdict, in git's words."""

    GOOD = "good"
    BAD = "bad"
    SKIP = "skip"


@dataclass(frozen=True, slots=True)
class TestedRevision:
    """A revision that was run. ``why`` says why it is skipped."""

    commit: Commit
    run: PerturbedRun
    answer: RevisionVerdict
    why: str = ""


@dataclass(frozen=True, slots=True)
class BisectResult:
    """The result of a search.

    ``first`` is the first changed commit; None if it is one of ``candidates``, of which all but the
    last were skipped. ``before`` and ``after`` are the runs before and after the change, ``tried``
    all revisions that were run, in order.
    """

    first: Commit | None
    candidates: tuple[Commit, ...]
    before: TestedRevision
    after: TestedRevision
    tried: tuple[TestedRevision, ...]
    notes: tuple[str, ...]


class BisectSearch:
    """A search between two commits. ``check`` None: by the digest.

    ``on_try`` receives each revision that was run, ``on_note`` further notes.
    """

    def __init__(
        self,
        runner: RevisionRunner,
        good: Commit,
        bad: Commit,
        check: RevisionCheck | None,
        *,
        first_parent: bool = False,
        on_try: Callable[[TestedRevision], object] = lambda tried: None,
        on_note: Callable[[str], object] = lambda note: None,
    ) -> None:
        self._runner = runner
        self._good, self._bad = good, bad
        self._check = check
        self._first_parent = first_parent
        self._on_try, self._on_note = on_try, on_note
        self._tried: dict[str, TestedRevision] = {}
        self._notes: list[str] = []
        self._failure_counts = False
        """Whether a run in which a node raises is judged, not skipped: one end raises, too."""

    def find(self) -> BisectResult:
        """Search.

        :raises BisectError: an end does not run, is not good or bad, or is nondeterministic.
        """
        good, bad = self._ends()
        tree = self._runner.worktree
        words = ["start", *(["--first-parent"] if self._first_parent else [])]
        said = tree.bisect(*words, bad.commit.id, good.commit.id, "--")
        while True:
            if (first := _FIRST.search(said)) is not None:
                return self._found([first[1]])
            if _ANY_OF in said:
                listed = said.split(_ANY_OF, 1)[1].split("\n")
                return self._found([line for line in listed if _COMMIT.fullmatch(line)])
            if (left := _LEFT.search(said)) is not None:
                self._on_note(f"revisions left after this one: {left[1]}, runs: about {left[2]}")
            elif "merge base must be tested" in said:
                self._on_note(
                    "neither end comes from the other: the commit where they diverge is run"
                )
            said = tree.bisect(self._at(tree.head).answer.value)

    # -- the ends --------------------------------------------------------------------------------

    def _ends(self) -> tuple[TestedRevision, TestedRevision]:
        good, bad = self._end(self._good, "good"), self._end(self._bad, "bad")
        self._failure_counts = bool(good.failure or bad.failure)
        if self._check is None and good.outcome == bad.outcome:
            raise BisectError(
                f"{self._good.short} and {self._bad.short} have the same run ({good.events} "
                f"events, digest {good.digest}): there is no change to find; for a change that "
                "the digest does not show, use --check or --run"
            )
        self._digest = good.outcome
        ends = []
        for commit, run, wanted in (
            (self._good, good, RevisionVerdict.GOOD),
            (self._bad, bad, RevisionVerdict.BAD),
        ):
            again = self._run(commit, "again")
            if again.outcome != run.outcome:
                raise BisectError(
                    f"the job is not deterministic at {commit}: two runs have the digests "
                    f"{run.digest or '-'} and {again.digest or '-'}; run rsltrace verify there"
                )
            ends.append(self._tell(self._judged(commit, run)))
            self._expect(ends[-1], wanted)
        return ends[0], ends[1]

    def _end(self, commit: Commit, name: str) -> PerturbedRun:
        begin = time.monotonic()
        run = self._run(commit)
        if self._runner.timeout_s is None:
            timeout_s = max(_TIMEOUT_MIN_S, _TIMEOUT_FACTOR * (time.monotonic() - begin))
            self._runner = replace(self._runner, timeout_s=timeout_s)
        if not run.digest:
            raise BisectError(f"the {name} revision ({commit}) does not run: {self._why(run)}")
        return run

    def _expect(self, tried: TestedRevision, wanted: RevisionVerdict) -> None:
        if tried.answer is wanted:
            return
        assert self._check is not None
        if tried.answer is RevisionVerdict.SKIP:
            raise BisectError(f"{wanted.value} revision {tried.commit}: {tried.why}")
        does = "fails" if wanted is RevisionVerdict.GOOD else "holds"
        raise BisectError(
            f"{self._check.words!r} {does} at {tried.commit}, the {wanted.value} revision"
        )

    # -- one revision ----------------------------------------------------------------------------

    def _at(self, commit_id: str) -> TestedRevision:
        """Run and judge the revision in the worktree, once."""
        if commit_id in self._tried:
            return self._tried[commit_id]
        commit = self._runner.repository.commit(commit_id)
        run = self._run(commit)
        return self._tell(self._judged(commit, run))

    def _judged(self, commit: Commit, run: PerturbedRun) -> TestedRevision:
        if not run.digest or (run.failure and not self._failure_counts):
            return TestedRevision(commit, run, RevisionVerdict.SKIP, self._why(run))
        if self._check is not None:
            try:
                holds = self._check.judge(run.path, self._runner.folder)
            except BisectError as error:
                return TestedRevision(commit, run, RevisionVerdict.SKIP, str(error))
            return TestedRevision(
                commit, run, RevisionVerdict.GOOD if holds else RevisionVerdict.BAD
            )
        if run.outcome == self._digest:
            return TestedRevision(commit, run, RevisionVerdict.GOOD)
        seen = any(run.outcome == known.run.outcome for known in self._tried.values())
        if not seen and commit != self._bad:
            again = self._run(commit, "again")
            if again.outcome != run.outcome:
                why = f"not deterministic: digests {run.digest} and {again.digest or '-'}"
                return TestedRevision(commit, run, RevisionVerdict.SKIP, why)
        return TestedRevision(commit, run, RevisionVerdict.BAD)

    def _run(self, commit: Commit, more: str = "") -> PerturbedRun:
        tree = self._runner.worktree
        tree.check_out(commit.id)
        if missing := tree.missing_submodules():
            self._note(f"submodules are not checked out: {', '.join(missing)}")
        return self._runner.run("-".join(filter(None, (commit.id, more))))

    def _tell(self, tried: TestedRevision) -> TestedRevision:
        self._tried[tried.commit.id] = tried
        self._on_try(tried)
        return tried

    def _why(self, run: PerturbedRun) -> str:
        """Return why a run failed: its error message, if it printed one."""
        said = [line for line in run.errors.splitlines() if line.startswith(_ERROR)]
        why = run.failure if run.digest or not said else said[-1].removeprefix(_ERROR)
        return why.replace(f"{self._runner.worktree.tree}/", "")

    def _note(self, text: str) -> None:
        if text not in self._notes:
            self._notes.append(text)
            self._on_note(text)

    # -- the answer ------------------------------------------------------------------------------

    def _found(self, ids: list[str]) -> BisectResult:
        candidates = self._runner.repository.in_order(ids, self._good, self._bad)
        first = candidates[0] if len(candidates) == 1 else None
        known = [one for one in self._tried.values() if one.answer is RevisionVerdict.BAD]
        after = next((one for one in known if one.commit.id in ids), known[0])
        return BisectResult(
            first,
            tuple(candidates),
            self._before(first),
            after,
            tuple(self._tried.values()),
            tuple(self._notes),
        )

    def _before(self, first: Commit | None) -> TestedRevision:
        """Return the run to compare with: of the commit's parent, if that runs."""
        if first is not None:
            found = self._at(first.parents[0])
            if found.answer is not RevisionVerdict.SKIP:
                return found
        return [one for one in self._tried.values() if one.answer is RevisionVerdict.GOOD][-1]
