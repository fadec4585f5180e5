"""Running a job at a revision: in a process of its own, with the code of the worktree."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rsltrace.campaign.bisect.repository import Repository
from rsltrace.campaign.bisect.worktree import Worktree
from rsltrace.campaign.perturb import (
    Recorded,
    Surroundings,
    can_fix_addresses,
    record_words,
    recorded,
)
from rsltrace.campaign.processes import OWN_FOLDER, Processes, rsltrace_command


@dataclass(frozen=True, slots=True)
class Runner:
    """Runs a job in a worktree; ``arguments`` are those of ``rsltrace record``, with paths there.

    ``cwd`` is the present folder, as seen there.
    """

    repository: Repository
    worktree: Worktree
    arguments: tuple[str, ...]
    processes: Processes
    timeout_s: float | None = None

    def run(self, name: str) -> Recorded:
        """Run what is in the worktree; the trace gets a name of its own."""
        cwd = self.folder
        cwd.mkdir(parents=True, exist_ok=True)
        path = self.worktree.folder / f"{name}.mcap"
        command = rsltrace_command(record_words(self.arguments, path))
        if can_fix_addresses():
            command = ["setarch", "-R", *command]
        done = self.processes.run(
            command, cwd=cwd, env=self._environment(), timeout_s=self.timeout_s
        )
        return recorded(Surroundings(0, {}), path, done)

    @property
    def folder(self) -> Path:
        """The present folder, in the worktree or as seen from there."""
        return self.worktree.path(Path.cwd())

    @property
    def python_path(self) -> list[str]:
        """The folders of the worktree that stand for those of the checkout on Python's path.

        So a package that is installed in place (``pip install -e``) is that of the revision.
        """
        found = []
        for entry in dict.fromkeys(sys.path):
            path = Path(entry or ".").resolve()
            if path == OWN_FOLDER or not path.is_relative_to(self.repository.top):
                continue  # this program itself is the same at every revision
            if path.is_relative_to(Path(sys.prefix).resolve()) or not path.is_dir():
                continue
            found.append(str(self.worktree.path(path)))
        return found

    def _environment(self) -> Mapping[str, str]:
        given = os.environ.get("PYTHONPATH")
        path = [*self.python_path, *([given] if given else [])]
        return {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(path),
            "PYTHONHASHSEED": "0",
            # Sources of the same length within the same second: bytecode would be another's.
            "PYTHONDONTWRITEBYTECODE": "1",
        }
