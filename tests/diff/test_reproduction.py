"""A third run repeats one of two that diverge, or neither, or ended too early to tell."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rsltrace
from rsltrace.diff.traces.diff import Repeats, Reproduction, reproduction
from rsltrace.errors import TraceError
from rsltrace.trace.reader import Trace

SAMPLES = Path(__file__).parent.parent.parent / "sample_traces"
PAIR = SAMPLES / "nondeterministic_callback"


def found(a: Path, b: Path, again: Path) -> Reproduction:
    with Trace.open(a) as one, Trace.open(b) as other, Trace.open(again) as third:
        return reproduction(one, other, third)


def test_the_runs_themselves_are_repeated() -> None:
    a, b = PAIR / "a.mcap", PAIR / "b.mcap"
    assert found(a, b, a).repeats is Repeats.A
    assert found(a, b, b).repeats is Repeats.B
    assert found(b, a, b).repeats is Repeats.A
    third = found(a, b, SAMPLES / "schedule" / "a.mcap")
    assert (third.repeats, third.exit_code) == (Repeats.NEITHER, 1)
    assert "a third result: it differs from a at event 0" in third.sentence


def rsltrace_command(*words: str, hash_seed: str = "0") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "rsltrace", *words],
        cwd=PAIR,
        env={**os.environ, "PYTHONHASHSEED": hash_seed},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.long
@pytest.mark.few(1)
@pytest.mark.ros
@pytest.mark.skipif(sys.version_info < (3, 11), reason="3.10 hashes strings in another way")
@pytest.mark.parametrize(
    ("until", "seed", "code", "said"),
    [
        ("2.1", "1", 0, "reproduces a: it does the same at event 64, where a and b diverge."),
        ("2.1", "3", 0, "reproduces b: it does the same at event 64, where a and b diverge."),
        ("2.0", "1", 1, "ends before event 64, where a and b diverge: record more."),
    ],
)
def test_the_next_step_is_not_fooled_by_its_own_until(
    until: str, seed: str, code: int, said: str, tmp_path: Path
) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    report = rsltrace_command("diff", "a.mcap", "b.mcap").stdout.splitlines()[-1]
    assert "--until 2.1 -o again.mcap" in report
    assert report.endswith("rsltrace diff a.mcap b.mcap --again again.mcap")
    again = str(tmp_path / "again.mcap")
    made = rsltrace_command("record", "job.yaml", "--until", until, "-o", again, hash_seed=seed)
    assert made.returncode == 0, made.stderr
    done = rsltrace_command("diff", "a.mcap", "b.mcap", "--again", again)
    assert done.returncode == code
    assert said in " ".join(done.stdout.split())


def test_a_third_run_needs_two_others() -> None:
    done = rsltrace_command("diff", "a.mcap", "b.mcap", "a.mcap", "--again", "a.mcap")
    assert done.returncode == 2
    assert "--again needs two traces" in done.stderr


def test_names_that_neither_run_has_are_errors() -> None:
    with pytest.raises(TraceError, match="neither run has a node /lidr; did you mean '/lidar'"):
        rsltrace.diff(PAIR / "a.mcap", PAIR / "b.mcap", nodes="/lidr")
    with pytest.raises(TraceError, match="topic or service /sca; did you mean '/scan'"):
        rsltrace.diff(PAIR / "a.mcap", PAIR / "b.mcap", topics="/sca")
    assert rsltrace.diff(PAIR / "a.mcap", PAIR / "b.mcap", topics="/sc*").divergences
