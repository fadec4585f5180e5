"""A fit of a real native run: what it measures, and that its job runs and is checked."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.ros,
    pytest.mark.native,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs rclpy"),
]

PIPELINE = Path(__file__).resolve().parents[2] / "examples" / "pipeline"
CHAIN = "/image → /objects → /tracks → /command"


def rsltrace(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", *words],
        cwd=folder,
        env={**os.environ, "ROS_LOG_DIR": str(folder / "log")},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return done


def test_a_native_run_becomes_a_simulation_with_its_latencies(tmp_path: Path) -> None:
    """How near they are depends on the machine; that they are of the robot's size does not: without
    delays and execution times they would be 0."""
    pytest.importorskip("scipy")
    (tmp_path / "pipeline.py").write_text((PIPELINE / "pipeline.py").read_text())
    job = (PIPELINE / "job.yaml").read_text()
    job = job.replace("duration: 60s", "events: 300\n  timeout: 300s")
    (tmp_path / "job.yaml").write_text(job)
    for name in ("first", "second"):
        rsltrace(tmp_path, "record", "--native", "job.yaml", "-o", f"{name}.mcap")
    done = rsltrace(
        tmp_path, "fit", "first.mcap", "-o", "fitted.yaml", "--check", "second.mcap", "--json"
    )
    found = json.loads(done.stdout)
    links = {(one["topic"], one["from"], one["to"]): one for one in found["delays"]}
    assert set(links) == {
        ("/image", "/camera", "/detector"),
        ("/objects", "/detector", "/tracker"),
        ("/tracks", "/tracker", "/controller"),
        ("/command", "/controller", "/actuator"),
    }
    for link in links.values():
        assert link["negative"] == 0
        assert link["delay"]["count"] > 20
    busy = {one["node"]: one for one in found["execution"]}
    for one in busy.values():
        assert one["busy"]["p50_ns"] >= one["callback"]["p50_ns"]
    assert busy["/detector"]["callback"]["p50_ns"] > busy["/controller"]["callback"]["p50_ns"]
    assert [len(one["nodes"]) for one in found["executors"]] == [1] * 5
    (check,) = found["check"]
    assert check["chain"] == CHAIN
    computing = sum(busy[node]["callback"]["p50_ns"] for node in ("/detector", "/tracker"))
    median = check["simulated"]["quantiles"][0]
    assert median["b_ns"] > 0.7 * computing
    assert check["first_run"]["quantiles"][0]["ratio"] > 0
    assert "policy: rclpy" in (tmp_path / "fitted.yaml").read_text()
