"""``rsltrace completion``: what bash is given completes commands and options."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
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
