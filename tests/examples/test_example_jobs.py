"""Every example job runs under rsltrace and comes to the end that its README promises."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
HUSKY = ROOT.parent / "shared" / "data" / "husky_outdoor"
pytestmark = pytest.mark.ros

JOBS = sorted(path.relative_to(EXAMPLES).as_posix() for path in EXAMPLES.glob("*/job*.yaml"))


def run(name: str, capfd: pytest.CaptureFixture[str]) -> tuple[Any, str]:
    """Run an example without recording; return the result and what its nodes logged."""
    from rsltrace import load_job, record

    result = record(load_job(EXAMPLES / name), None, echo=True)
    assert result.exit_code == 0
    return result, capfd.readouterr().err


@pytest.mark.parametrize("name", JOBS)
def test_a_job_is_valid_and_its_readme_names_it(name: str) -> None:
    from rsltrace import load_job

    readme = (EXAMPLES / name).parent / "README.md"
    assert f"rsltrace record examples/{name}" in readme.read_text()
    if "husky" in name and not HUSKY.exists():
        pytest.skip("the Husky recording is not here")
    assert load_job(EXAMPLES / name).nodes


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "callbacks"),
    [
        ("ping_pong/job.yaml", 30_000),
        ("ping_pong/job_burst.yaml", 200_001),
        ("benchmark8/job.yaml", 50_600),
        ("benchmark8/job_200_nodes.yaml", 50_600),
    ],
)
def test_a_measured_job_has_the_callbacks_it_says(
    name: str, callbacks: int, capfd: pytest.CaptureFixture[str]
) -> None:
    result, _ = run(name, capfd)
    # Constructions are events too, and the last period may be cut off.
    assert result.events == pytest.approx(callbacks, abs=250)


def test_the_robot_drives_its_laps_and_knows_where_it_is(capfd: pytest.CaptureFixture[str]) -> None:
    result, log = run("sensor_fusion/job.yaml", capfd)
    assert result.events <= 40_000
    assert result.sim_seconds == "60.000000000"
    laps = [float(seconds) for seconds in re.findall(r"lap \d done in ([\d.]+) s", log)]
    assert len(laps) == 2
    assert laps[0] == pytest.approx(laps[1], rel=0.05)
    last = log.strip().splitlines()[-1]
    found = re.search(r"to the truth ([\d.]+) m rms, ([\d.]+) m at most", last)
    assert found, last
    assert float(found[1]) < 0.25  # one fix alone errs by 0.85 m
    assert float(found[2]) < 0.6
    assert "refused" not in log


@pytest.mark.long
@pytest.mark.skipif(not HUSKY.exists(), reason="the Husky recording is not here")
def test_the_real_robot_is_followed_to_its_end(capfd: pytest.CaptureFixture[str]) -> None:
    result, log = run("sensor_fusion/job_husky.yaml", capfd)
    assert result.sim_seconds == "396.000000000"
    assert "heading found: " in log
    last = log.strip().splitlines()[-1]
    found = re.search(r"driven ([\d.]+) m.* filter to GPS ([\d.]+) m rms", last)
    assert found, last
    assert float(found[1]) == pytest.approx(347, abs=5)
    assert float(found[2]) < 2.5
