"""The git repository of a job, read with ``git``. Nothing here changes it."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from rsltrace.errors import BisectError, SetupError

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
