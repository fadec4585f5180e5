"""What takes long says so on a terminal, and in a pipe not a word."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

SAMPLE = Path(__file__).parents[2] / "sample_traces" / "missing_event" / "a.mcap"


@pytest.mark.few(1)
@pytest.mark.parametrize("words", [["export", SAMPLE, "-o", "bag"], ["info", "--check", SAMPLE]])
def test_progress_is_for_terminals(words: list[object], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rsltrace", *map(str, words)]
    main, side = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    seen = b""
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=side, cwd=tmp_path, env=environment
    ) as shown:
        os.close(side)
        with suppress(OSError):  # the end of a terminal
            while piece := os.read(main, 4096):
                seen += piece
        assert shown.stdout is not None
        printed = shown.stdout.read()
    os.close(main)
    assert shown.returncode == 0
    assert (b"writing bag" if "export" in words else b"checking") in seen
    quiet = subprocess.run(
        [*command, *(["--force"] if "export" in words else [])],
        capture_output=True,
        cwd=tmp_path,
        env=environment,
        check=True,
    )
    assert b"writing bag" not in quiet.stderr
    assert b"checking" not in quiet.stderr
    assert b"\x1b" not in quiet.stderr + quiet.stdout + printed
