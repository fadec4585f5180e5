"""The hook for pre-commit looks at each job by itself, and stops a commit with a wrong one."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NODE = """
from rclpy.node import Node

class Talker(Node):
    def __init__(self):
        super().__init__("talker")
"""


def git(folder: Path, *words: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    own = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main")
    return subprocess.run(
        ["git", *own, *words],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600,
    )


@pytest.mark.long
@pytest.mark.ros
def test_a_commit_with_a_wrong_job_is_stopped(tmp_path: Path) -> None:
    pytest.importorskip("pre_commit")
    pytest.importorskip("rclpy")
    programs = os.pathsep.join((str(Path(sys.executable).parent), "/usr/bin", "/bin"))
    environment = {"PATH": programs, "HOME": str(tmp_path), "PRE_COMMIT_HOME": str(tmp_path / "p")}
    hooks, mine = tmp_path / "hooks", tmp_path / "mine"
    for folder in (hooks, mine):
        folder.mkdir()
        git(folder, "init", environment=environment)
    shutil.copy(ROOT / ".pre-commit-hooks.yaml", hooks)
    git(hooks, "add", ".", environment=environment)
    git(hooks, "commit", "-m", "hooks", environment=environment)
    revision = git(hooks, "rev-parse", "HEAD", environment=environment).stdout.strip()
    (mine / ".pre-commit-config.yaml").write_text(
        f"repos: [{{repo: '{hooks}', rev: '{revision}', hooks: [{{id: rsltrace-check}}]}}]\n"
    )
    (mine / "talker.py").write_text(NODE)
    for name in ("job.yaml", "job_two.yaml"):
        (mine / name).write_text("nodes: [{node: 'talker:Talker'}]\nstop: {duration: 1s}\n")
    (mine / "other.yaml").write_text("no: job\n")
    install = [sys.executable, "-m", "pre_commit", "install"]
    subprocess.run(install, cwd=mine, env=environment, check=True, timeout=600, capture_output=True)
    git(mine, "add", ".", environment=environment)
    done = git(mine, "commit", "-m", "good", environment=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Passed" in done.stdout + done.stderr

    (mine / "job_two.yaml").write_text("nodes: [{nod: 'talker:Talker'}]\n")
    git(mine, "add", ".", environment=environment)
    done = git(mine, "commit", "-m", "bad", environment=environment)
    assert done.returncode == 1
    said = done.stdout + done.stderr
    assert "job_two.yaml:1:10: unknown key 'nod' in nodes[0]; did you mean 'node'?" in said
