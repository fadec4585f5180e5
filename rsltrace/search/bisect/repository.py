"""The git repository of a job, read with ``git``. Nothing here changes it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from rsltrace.errors import BisectError, SetupError

# A git worktree for one search.
#
# It is in a folder that mirrors the paths of this machine: paths in the repository are those of
# the revision, all others are links to the real ones. So a job's ``../../data/drive`` is found.
#
# Another process removes the worktree when this one ends, however it ends.

# Waits until its stdin is closed by the parent or the kernel. A git or a run that is just ending
# may still write, so it tries again.
_CLEANER = """
import os, shutil, subprocess, sys, time
git, top, tree, folder = sys.argv[1:]
sys.stdin.buffer.read()
quiet = dict(stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
for _ in range(100):
    subprocess.run([git, 'worktree', 'remove', '--force', '--force', tree], cwd=top, **quiet)
    shutil.rmtree(folder, ignore_errors=True)
    listed = subprocess.run([git, 'worktree', 'list', '--porcelain', '-z'], cwd=top,
                            stdin=subprocess.DEVNULL, capture_output=True).stdout
    if not os.path.lexists(folder) and os.fsencode(tree) not in listed:
        break
    time.sleep(0.1)
"""


class Worktree:
    """A detached worktree of a repository, for the time of a ``with`` block.

    ``shared`` are untracked files and folders of the checkout that runs need: they are linked
    unless the revision has one of that name. ``folder`` is for traces.
    """

    def __init__(self, repository: GitRepository, shared: Iterable[Path] = ()) -> None:
        self._repository = repository
        self._shared = tuple(shared)

    def __enter__(self) -> Worktree:
        top = self._repository.top
        base = Path(tempfile.mkdtemp(prefix="rsltrace-bisect-")).resolve()
        self._root = base / "root"
        self.folder = base / "runs"
        self.tree = self.path(top)
        command = [sys.executable, "-I", "-c", _CLEANER, git_program()]
        self._cleaner = subprocess.Popen(
            [*command, str(top), str(self.tree), str(base)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=git_environment(),
            cwd="/",
            start_new_session=True,
        )
        try:
            self.folder.mkdir()
            self._mirror(base)
            git(top, "worktree", "add", "--quiet", "--detach", "--no-checkout", str(self.tree))
        except BaseException:
            self._clean()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._clean()

    def path(self, path: Path | str) -> Path:
        """Return where a run finds a path of this machine."""
        absolute = os.path.abspath(path)
        real = os.path.join(os.path.realpath(os.path.dirname(absolute)), os.path.basename(absolute))
        return self._root / os.path.relpath(real, "/")

    def check_out(self, revision: str) -> None:
        """Check out a clean revision. Raises BisectError if git cannot."""
        git(self.tree, "reset", "--quiet", "--hard", revision)
        git(self.tree, "clean", "-ffdxq")
        self._share()

    def bisect(self, *words: str) -> str:
        """Run a step of ``git bisect``, which checks out the next revision; return its output.

        :raises BisectError: git fails.
        """
        git(self.tree, "reset", "--quiet", "--hard")
        git(self.tree, "clean", "-ffdxq")
        done = git(self.tree, "bisect", *words, check=False)
        said = done.output
        if done.exit_code not in (0, 2) or (done.exit_code == 2 and "could be any of" not in said):
            raise BisectError(f"git bisect: {(done.errors.strip() or said.strip())}")
        self._share()
        return said

    @property
    def head(self) -> str:
        """The commit that is checked out."""
        return git(self.tree, "rev-parse", "HEAD").output.strip()

    def missing_submodules(self) -> tuple[str, ...]:
        """Return the submodules of the revision: none is checked out."""
        listed = git(self.tree, "ls-files", "--stage", "-z").output.split("\0")
        return tuple(line.split("\t", 1)[1] for line in listed if line.startswith("160000 "))

    def _mirror(self, base: Path) -> None:
        """Make the folders on the path to the repository, with links to all their siblings."""
        real, here = Path("/"), self._root
        for part in self._repository.top.relative_to("/").parts:
            here.mkdir()
            try:
                beside = [entry.name for entry in os.scandir(real)]
            except OSError:
                beside = []  # a folder that may be entered, but not listed
            for name in beside:
                if name != part and real / name != base:
                    (here / name).symlink_to(real / name)
            real, here = real / part, here / part

    def _share(self) -> None:
        for path in self._shared:
            place = self.path(path)
            if not os.path.lexists(place):
                place.parent.mkdir(parents=True, exist_ok=True)
                place.symlink_to(path)

    def _clean(self) -> None:
        assert self._cleaner.stdin is not None
        self._cleaner.stdin.close()
        self._cleaner.wait()


_LOCAL = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_PREFIX", "GIT_COMMON_DIR")
_QUIETLY = (
    *("-c", f"core.hooksPath={os.devnull}"),  # no hooks for our checkouts
    *("-c", "advice.detachedHead=false"),
    *("-c", "gc.auto=0"),
)


@dataclass(frozen=True, slots=True)
class Commit:
    """A commit: its full hash, the short one, date (YYYY-MM-DD), author and first line."""

    id: str
    short: str
    date: str
    author: str
    subject: str
    parents: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.short} {self.subject}"


@dataclass(frozen=True, slots=True)
class GitOutput:
    """Output and exit status of a git command."""

    exit_code: int
    output: str
    errors: str


def git(folder: Path, *words: str, check: bool = True) -> GitOutput:
    """Run git in a folder, without hooks and in English.

    :raises SetupError: there is no git.
    :raises BisectError: it failed, in its words, unless not ``check``.
    """
    done = subprocess.run(
        [git_program(), *_QUIETLY, *words],
        cwd=folder,
        env=git_environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        errors="surrogateescape",
        check=False,
    )
    if check and done.returncode != 0:
        said = (done.stderr.strip() or done.stdout.strip()).replace("fatal: ", "")
        raise BisectError(f"git {words[0]} in {folder}: {said}")
    return GitOutput(done.returncode, done.stdout, done.stderr)


@lru_cache
def git_program() -> str:
    """Return the path of git, or raise SetupError."""
    found = shutil.which("git")
    if found is None:
        raise SetupError("rsltrace bisect needs git, which is not on the PATH")
    return found


def git_environment() -> dict[str, str]:
    """Return an environment in which git uses the repository of its folder, and English."""
    env = {name: value for name, value in os.environ.items() if name not in _LOCAL}
    return {**env, "LC_ALL": "C", "GIT_TERMINAL_PROMPT": "0"}


class GitRepository:
    """A repository with a checkout in ``top``."""

    def __init__(self, top: Path) -> None:
        self.top = top

    @classmethod
    def of(cls, file: Path) -> GitRepository:
        """Return the repository that a file lies in.

        :raises BisectError: there is none.
        """
        folder = file.parent
        if not folder.is_dir():
            raise BisectError(f"{file}: there is no such folder")
        done = git(folder, "rev-parse", "--show-toplevel", check=False)
        if done.exit_code != 0 or not done.output.strip():
            said = done.errors.strip().removeprefix("fatal: ").splitlines()
            raise BisectError(
                f"{file} is not in a checkout of a git repository, so there are no revisions to "
                f"run ({said[0] if said else 'a bare repository'})"
            )
        return cls(Path(done.output.removesuffix("\n")))

    def commit(self, revision: str) -> Commit:
        """Return the commit that a revision (a tag, branch, hash, ``HEAD~3``) means.

        :raises BisectError: there is none of that name.
        """
        words = ("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")
        found = git(self.top, *words, check=False)
        if found.exit_code != 0 or not found.output.strip():
            shallow = git(self.top, "rev-parse", "--is-shallow-repository").output.strip() == "true"
            hint = " (this is a shallow clone: git fetch --unshallow)" if shallow else ""
            raise BisectError(f"{self.top} has no revision {revision!r}{hint}")
        form = "--format=%H%x00%h%x00%as%x00%an%x00%s%x00%P"
        shown = git(self.top, "show", "--no-patch", form, found.output.strip()).output
        commit, short, date, author, subject, parents = shown.rstrip("\n").split("\0")
        return Commit(commit, short, date, author, subject, tuple(parents.split()))

    def is_ancestor(self, old: Commit, new: Commit) -> bool:
        """Return whether one commit is among those that led to another (or is that one)."""
        done = git(self.top, "merge-base", "--is-ancestor", old.id, new.id, check=False)
        return done.exit_code == 0

    def in_order(self, ids: Collection[str], old: Commit, new: Commit) -> list[Commit]:
        """Return commits between two others, the oldest first."""
        words = ("rev-list", "--topo-order", "--reverse", new.id, f"^{old.id}")
        return [self.commit(one) for one in git(self.top, *words).output.split() if one in ids]

    def changed_files(self, commit: Commit) -> tuple[str, ...]:
        """Return the files that a commit changed (of a merge: against its first parent)."""
        words = ("diff-tree", "-r", "--root", "--no-commit-id", "--name-only", "-z")
        ends = (f"{commit.parents[0]}", commit.id) if commit.parents else (commit.id,)
        return tuple(filter(None, git(self.top, *words, *ends).output.split("\0")))

    def has_tracked(self, path: Path) -> bool:
        """Return whether a file of the checkout, or something in that folder, is tracked."""
        return bool(git(self.top, "ls-files", "-z", "--", f":(literal){path}").output)
