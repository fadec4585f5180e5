"""Records the sample pairs and writes the reports of their diffs: ``make samples``.

Every pair is one job run twice. What differs between the two runs is what the sample shows; it
comes from outside of the program (the hash seed of Python, hardware that is slow, ...), and is
pinned here so that the same traces come out whenever they are made.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Run:
    """One run of a sample: the job file and what its process is given from outside."""

    job: str = "job.yaml"
    environment: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Pair:
    """A sample: its folder, its two runs, and the verdict of their diff."""

    folder: str
    a: Run
    b: Run
    verdict: str


PAIRS = (
    Pair(
        "nondeterministic_callback",
        Run(environment={"PYTHONHASHSEED": "1"}),
        Run(environment={"PYTHONHASHSEED": "3"}),
        "same-input-different-output",
    ),
    Pair("schedule", Run(), Run("job_b.yaml"), "schedule"),
    Pair(
        "delayed_input",
        Run(environment={"BUS_SEED": "31"}),
        Run(environment={"BUS_SEED": "29"}),
        "timing",
    ),
    Pair(
        "missing_event",
        Run(environment={"MOTOR_SEED": "6"}),
        Run(environment={"MOTOR_SEED": "4"}),
        "missing",
    ),
)


def record(folder: Path, run: Run, output: Path) -> None:
    """Record one run of a sample in a process of its own."""
    command = [sys.executable, "-m", "rsltrace", "record", run.job, "-o", str(output)]
    subprocess.run(
        [*command, "--force", "--quiet"],
        cwd=folder,
        env={**os.environ, **run.environment},
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def report(folder: Path) -> str:
    """Return what ``rsltrace diff`` prints of a sample. Its exit status must be 1: they diverge."""
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", "diff", "a.mcap", "b.mcap"],
        cwd=folder,
        capture_output=True,
        text=True,
        encoding="utf-8",
        env={**os.environ, "PYTHONIOENCODING": "utf-8"},
        check=False,
    )
    if done.returncode != 1:
        raise SystemExit(f"{folder.name}: exit status {done.returncode}: {done.stderr}")
    return done.stdout


def main() -> None:
    """Make all pairs, or those named on the command line."""
    wanted = sys.argv[1:] or [pair.folder for pair in PAIRS]
    for pair in PAIRS:
        if pair.folder in wanted:
            folder = HERE / pair.folder
            record(folder, pair.a, folder / "a.mcap")
            record(folder, pair.b, folder / "b.mcap")
            (folder / "report.txt").write_text(report(folder), encoding="utf-8")
            print(f"{pair.folder}: {pair.verdict}")


if __name__ == "__main__":
    main()
