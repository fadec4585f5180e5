"""``rsltrace completion``: what bash is given completes commands and options."""

from __future__ import annotations

import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from rsltrace.cli.main import cli

ASK = """
source {script}
COMP_WORDS=({words}); COMP_CWORD={at}
_rsltrace_completion rsltrace
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("rsltrace", "re"), {"record", "replay", "rerun"}),
        (("rsltrace", "diff", "--ign"), {"--ignore"}),
    ],
)
def test_bash_completes(tmp_path: Path, words: tuple[str, ...], expected: set[str]) -> None:
    script = tmp_path / "completion.bash"
    script.write_text(CliRunner().invoke(cli, ["completion", "bash"]).output)
    program = tmp_path / "rsltrace"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m rsltrace "$@"\n')
    program.chmod(0o755)
    ask = ASK.format(script=script, words=" ".join(words), at=len(words) - 1)
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", ask],
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    assert expected <= set(done.stdout.split()), done.stderr


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_have_a_script(shell: str) -> None:
    done = CliRunner().invoke(cli, ["completion", shell])
    assert "_RSLTRACE_COMPLETE" in done.output, done.output


@pytest.mark.long
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_files_where_a_command_takes_them(tmp_path: Path) -> None:
    """With the tab key, at a terminal: whether files are offered is bash's own affair."""
    script = tmp_path / "completion.bash"
    script.write_text(CliRunner().invoke(cli, ["completion", "bash"]).output)
    folder = tmp_path / "runs"
    folder.mkdir()
    (folder / "robot_run.mcap").touch()
    program = tmp_path / "rsltrace"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m rsltrace "$@"\n')
    program.chmod(0o755)
    environment = {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "TERM": "dumb", "PS1": ""}
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(folder)
        os.execve(shutil.which("bash") or "", ["bash", "--norc", "--noprofile", "-i"], environment)
    try:
        os.write(terminal, f"source '{script}'\n".encode())
        for typed in ("info ro", "diff --check ro", "record --quiet ro"):
            os.write(terminal, f"rsltrace {typed}\t".encode())
            _read_until(terminal, f"rsltrace {typed}bot_run.mcap".encode())
            os.write(terminal, b"\x15")  # clears the line
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(terminal)


def _read_until(terminal: int, wanted: bytes, seconds: float = 120) -> None:
    seen, end = b"", time.monotonic() + seconds
    while wanted not in seen:
        ready, _, _ = select.select([terminal], [], [], max(end - time.monotonic(), 0))
        assert ready, f"{wanted!r} did not come, but {seen!r}"
        seen += os.read(terminal, 4096)
