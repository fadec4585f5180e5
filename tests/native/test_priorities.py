"""Native runs with priorities: who is taken first, and what is said without permission."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click import UsageError

from rsltrace.cli.record import record
from rsltrace.native.priorities import LEVEL_MAX, LEVEL_MIN, level_of_period
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from tests.native.running import PATIENCE_S
from tests.native.running import record as run_natively

needs_rclpy = pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs rclpy")
COMMAND = [sys.executable, "-m", "rsltrace", "record", "--native"]
JOB = f"""
search_path: ['{Path(__file__).parent}']
nodes: [{{node: urgent:Backlog}}]
policy: {{priority: [{{entity: middle, priority: 30}}, {{entity: slow, priority: 20}}]}}
stop: {{function: urgent:finished, timeout: 300s}}
"""


def recorded_order(
    folder: Path, *words: str, without: tuple[str, ...] = ()
) -> tuple[list[str], str]:
    """Record natively; return the timers in the order in which they ran, and what was said."""
    (folder / "job.yaml").write_text(JOB)
    command = [*without, *COMMAND, "job.yaml", "-o", "run.mcap", "--force", *words]
    environment = {**os.environ, "ROS_LOG_DIR": str(folder / "log")}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    with Trace.open(folder / "run.mcap") as trace:
        events = [trace.event(index) for index in range(trace.event_count)]
        order = [trace.entity(e.entity).name for e in events if e.kind is EventKind.TIMER]
        described = trace.metadata("rsltrace:native")
        levels = trace.result.get("thread_priorities", "")
    return order, f"{done.stderr}\n{described}\n{levels}"


@pytest.mark.ros
@pytest.mark.native
@needs_rclpy
def test_the_most_urgent_of_what_is_ready_runs_first(tmp_path: Path) -> None:
    order, said = recorded_order(tmp_path)
    assert order == ["slow", "middle", "fast"]
    assert "without effect in the job: policy" in said
    order, said = recorded_order(tmp_path, "--policy", "rate_monotonic")
    assert order == ["fast", "middle", "slow"]
    assert "'policy': 'rate_monotonic'" in said
    assert "Warning" not in said
    order, said = recorded_order(tmp_path, "--policy", "priority")
    assert order == ["middle", "slow", "fast"]
    assert "without effect" not in said


@pytest.mark.ros
@pytest.mark.native
@needs_rclpy
def test_without_permission_the_run_goes_on_and_says_what_to_set(tmp_path: Path) -> None:
    """A limit of zero for whoever may not change it: root of this test gives the right up."""
    without: tuple[str, ...] = ("prlimit", "--rtprio=0:0")
    if os.geteuid() == 0:
        without = ("setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice", *without)
    if any(shutil.which(word) is None for word in without if not word.startswith("-")):
        pytest.skip("needs setpriv and prlimit")
    order, said = recorded_order(tmp_path, "--policy", "rate_monotonic", without=without)
    assert order == ["fast", "middle", "slow"]
    assert "no real-time priorities (SCHED_FIFO: operation not permitted" in said
    assert "/etc/security/limits.d/" in said
    assert "'priorities': 'which ready callback an executor takes'" in said


def test_shorter_periods_never_have_a_lower_real_time_priority() -> None:
    levels = [level_of_period(1_000 * 1.05**step) for step in range(400)]
    assert levels == sorted(levels, reverse=True)
    assert (levels[0], level_of_period(float("inf"))) == (LEVEL_MAX, LEVEL_MIN)
    assert level_of_period(10_000_000) > level_of_period(20_000_000) > level_of_period(10**9)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["job.yaml", "--policy", "priority"], "--policy"),
        (
            ["--native", "job.yaml", "--policy", "priority", "--executor", "multi"],
            "--policy needs single-threaded executors",
        ),
    ],
)
def test_options_that_make_no_sense(words: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        record.main(words, standalone_mode=False)


@pytest.mark.ros
@pytest.mark.native
@needs_rclpy
def test_a_node_that_has_nothing_to_do_ends_with_the_run(tmp_path: Path) -> None:
    text = "nodes: [{node: robot:Server}]\nstop: {duration: 500ms}\n"
    done = run_natively(tmp_path, text, "--policy", "rate_monotonic")
    assert done.returncode == 0, done.stderr
    assert "did not return" not in done.stderr
