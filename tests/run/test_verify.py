"""``rsltrace verify``: one digest, or the two runs that differ and what made them differ."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.run.perturb import KINDS, surroundings

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SETS = """
from rclpy.node import Node
class N(Node):
    def __init__(self):
        super().__init__('n')
        self.get_logger().info(' '.join({'a', 'b', 'c', 'd', 'e'}))
        TELL
"""
JOB = "nodes: [{node: 'sets:N'}]\nstop: {duration: 1s}\n"


@pytest.fixture
def job(tmp_path: Path) -> Callable[..., Path]:
    def write(more: str = "", tell: str = "pass") -> Path:
        (tmp_path / "sets.py").write_text(SETS.replace("TELL", tell))
        path = tmp_path / "job.yaml"
        path.write_text(JOB + more)
        return path

    return write


def test_surroundings_differ_from_run_to_run_and_not_from_time_to_time() -> None:
    assert surroundings(0).values == {}
    assert surroundings(3) == surroundings(3)
    assert surroundings(3).values != surroundings(4).values != surroundings(4, seed=1).values
    assert set(surroundings(1).values) <= set(KINDS)
    assert list(surroundings(1).only(KINDS[0]).values) == [KINDS[0]]


def test_one_digest_is_stated_as_what_was_tried(
    rsltrace: Callable[..., Any], job: Callable[..., Path]
) -> None:
    done = rsltrace("verify", job(), "--runs", "3", "--jobs", "2")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("3 runs, ")
    assert "perturbations, one digest: " in done.stdout


def test_a_job_that_depends_on_the_hash_seed_is_told_so(
    rsltrace: Callable[..., Any], job: Callable[..., Path], tmp_path: Path
) -> None:
    done = rsltrace("verify", job("guard: false\n"), "--runs", "6", "--keep", "kept")
    assert done.returncode == 1, done.stderr
    assert "not deterministic" in done.stdout
    assert "provoked by: hash seed (each alone is enough)" in done.stdout
    assert "environment: hash_seed  0" in done.stdout, "the diff is printed"
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {"a.mcap", "b.mcap"}


def test_a_job_that_differs_by_itself_is_told_so(
    rsltrace: Callable[..., Any], job: Callable[..., Path]
) -> None:
    path = job("guard: false\n", "import time; self.get_logger().info(str(time.time_ns()))")
    done = rsltrace("verify", path, "--runs", "3", "--json")
    assert done.returncode == 1
    result = json.loads(done.stdout)
    assert result["by_itself"] is True
    assert result["agrees"] is False
    assert len(result["digests"]) == 2


def test_a_job_that_cannot_run_is_no_answer(rsltrace: Callable[..., Any]) -> None:
    done = rsltrace("verify", "nothing.yaml")
    assert done.returncode == 2
    assert "there is no such job file" in done.stderr
