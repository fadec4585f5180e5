"""A git worktree for one search.

It is in a folder that mirrors the paths of this machine: paths in the repository are those of the
revision, all others are links to the real ones. So a job's ``../../data/drive`` is found.

Another process removes the worktree when this one ends, however it ends.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from rsltrace.errors import BisectError
from rsltrace.search.bisect.repository import GitRepository, git, git_environment, git_program

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
