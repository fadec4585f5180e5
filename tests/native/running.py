"""Starting native runs as a user does."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rsltrace.trace.reader import Trace

ROBOT = Path(__file__).parent
PATIENCE_S = 600
"""How long a test waits for what has to happen, however busy the machine is."""
COMMAND = [sys.executable, "-m", "rsltrace"]


def job(folder: Path, text: str) -> Path:
    path = folder / "job.yaml"
    path.write_text(f"search_path: ['{ROBOT}']\n{text}")
    return path


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "ROS_LOG_DIR": str(folder / "log")}


def record(folder: Path, text: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Record a job natively to ``run.mcap``."""
    command = [*COMMAND, "record", "--native", str(job(folder, text)), "-o", "run.mcap", *words]
    return subprocess.run(
        command,
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )


def wait_until(condition: Callable[[], bool], run: subprocess.Popen[str] | None = None) -> None:
    """Wait until a condition is met, while a run goes on."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert run is None or run.poll() is None, run.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def events_of(trace: Trace) -> list[Any]:
    return [trace.event(index) for index in range(trace.event_count)]
