"""KISS-ICP in a plain node: one digest on any number of processors, and right about where it is."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
pytest.importorskip("kiss_icp", reason="needs kiss-icp: pip install 'rsltrace[lidar]'")
pytest.importorskip("evo", reason="needs evo: pip install 'rsltrace[lidar]'")

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "lidar_odometry"
DATA = Path(os.environ.get("RSLTRACE_DATA", ROOT.parent / "shared" / "data"))
ROBOT = "nodes.SimulatedRobot.parameters."
pytestmark = pytest.mark.ros


def recorded(path: Path, job: str, *words: str, processors: int = 0) -> dict[str, Any]:
    """Record one of the example's jobs in a process of its own that may use so many processors."""
    allowed = sorted(os.sched_getaffinity(0))
    command = [sys.executable, "-m", "rsltrace", "record", str(EXAMPLE / job), "-o", str(path)]
    done = subprocess.run(
        [*command, "--json", *words],
        preexec_fn=lambda: os.sched_setaffinity(0, allowed[-processors:]),
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    return result


@pytest.mark.long
def test_processors_and_threads_make_no_difference(tmp_path: Path) -> None:
    few = ("--set", ROBOT + "sweeps=4", "--set", ROBOT + "columns=120")
    one = recorded(tmp_path / "one.mcap", "job.yaml", *few, processors=1)
    all_of_them = recorded(tmp_path / "all.mcap", "job.yaml", *few, "--set", "metrics=null")
    assert one["digest"] == all_of_them["digest"]
    assert one["findings"] == 0
    metrics = {name: found["value"] for name, found in one["metrics"].items()}
    assert 0 < metrics["absolute error"] < 100  # mm
    assert metrics["relative error"] is None  # that is of whole metres
    assert metrics["lost sweeps"] == 0


@pytest.mark.long
def test_the_whole_way_is_found(tmp_path: Path) -> None:
    result = recorded(tmp_path / "run.mcap", "job.yaml")
    metrics = {name: one["value"] for name, one in result["metrics"].items()}
    assert metrics["lost sweeps"] == 0
    assert 1 < metrics["absolute error"] < 80  # mm, after 7.6 m
    assert 1 < metrics["relative error"] < 80
    spread = recorded(tmp_path / "b.mcap", "job.yaml", "--set", ROBOT + "seed=8")["metrics"]
    assert spread["absolute error"]["value"] != metrics["absolute error"]


@pytest.mark.long
@pytest.mark.skipif(not (DATA / "lidar_sweeps").exists(), reason="the sweeps are not here")
def test_real_sweeps_are_laid_on_each_other(tmp_path: Path) -> None:
    from scipy.spatial import cKDTree

    import rsltrace

    recorded(tmp_path / "run.mcap", "job_sweeps.yaml")
    with rsltrace.Trace.open(tmp_path / "run.mcap") as trace:
        placed = [_points(trace, "/registered", data) for *_, data in _all(trace, "/registered")]
        seen = [_points(trace, "/points", data) for *_, data in _all(trace, "/points")]
        poses: list[Any] = [trace.decode("/odom", data) for *_, data in _all(trace, "/odom")]
    tree = cKDTree(placed[0])
    apart = {
        name: float(np.percentile(tree.query(points[::20])[0], 75))
        for name, points in (("as they are", seen[1]), ("laid on", placed[1]))
    }
    assert apart["laid on"] < 0.85 * apart["as they are"], apart
    assert 0.3 < poses[1].pose.pose.position.x < 0.7  # a car, a tenth of a second later


def _all(trace: Any, topic: str) -> list[Any]:
    return list(trace.messages(topic))


def _points(trace: Any, topic: str, data: bytes) -> Any:
    cloud = trace.decode(topic, data)
    rows = np.frombuffer(bytes(cloud.data), dtype="<f4").reshape(-1, cloud.point_step // 4)
    return rows[:, :3]


def test_a_broken_file_of_points_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    from lidar_demo.sweeps import read_ply

    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n" + b"".join(
        b"property float %c\n" % axis for axis in b"xyz"
    )
    good = np.arange(6, dtype="<f4")
    file = tmp_path / "sweep.ply"
    file.write_bytes(head + b"end_header\n" + good.tobytes())
    assert read_ply(file).tolist() == [[0, 1, 2], [3, 4, 5]]
    for content, said in (
        (head + b"end_header\n" + good.tobytes()[:-1], "ends within its points"),
        (head.replace(b"binary_little_endian", b"ascii"), "no binary PLY"),
        (head.replace(b"float y", b"list y") + b"end_header\n", "something else than points"),
        (head.replace(b" z", b" w") + b"end_header\n", "without x, y and z"),
    ):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=f"sweep.ply .*{said}"):
            read_ply(file)


@pytest.mark.long
def test_the_table_has_the_runs_that_are_kept(tmp_path: Path) -> None:
    """Also where an odometry has lost its way, and an error is unknown."""
    way = [[[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [1.0, 0.1]]]
    kept = [
        {"kind": kind, "loaded": loaded, "digest": digest, "absolute error": error, "ways": way}
        | {"relative error": None if loaded else error, "lost sweeps": lost}
        for kind, loaded, digest, error, lost in (
            *[("simulated", loaded, "1b", 42.0, 0) for loaded in (False, True)],
            *[("native", False, None, error, 3) for error in (50.0, 60.5, 60.25)],
            *[("native", True, None, error, 40) for error in (70.0, None, 700.0)],
        )
    ]
    (tmp_path / "runs.jsonl").write_text("".join(json.dumps(run) + "\n" for run in kept))
    script = ROOT / "benchmarks" / "lidar_odometry.py"
    done = subprocess.run(
        [sys.executable, str(script), "--simulated", "2", "--native", "3", "--to", str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
    )
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines()]
    same = "42.0000, 42.0000, 42.0000"
    assert rows[2:] == [
        ["1 simulated", "no", "1", same, "42.0000 to 42.0000", "0 to 0", "1"],
        ["1 simulated", "yes", "1", same, "–", "0 to 0", "1"],
        ["3 native", "no", "3", "50.0000, 60.2500, 60.5000", "50.0000 to 60.5000", "3 to 3", "–"],
        ["3 native", "yes", "2", "70.0000, 385.0000, 700.0000", "–", "40 to 40", "–"],
    ]
    assert "<svg" in (tmp_path / "errors.svg").read_text()
