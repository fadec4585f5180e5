"""Job files with node modules of their own, recorded in this process or through the command."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.forked_command import Forks, can_fork

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

if "demo_packages" not in sys.modules:  # tests are imported without their folder
    _spec = importlib.util.spec_from_file_location(
        "demo_packages", Path(__file__).with_name("demo_packages.py")
    )
    assert _spec is not None
    assert _spec.loader is not None
    sys.modules["demo_packages"] = importlib.util.module_from_spec(_spec)
    _spec.loader.exec_module(sys.modules["demo_packages"])

TALKER = """
from rclpy.node import Node
from std_msgs.msg import Int32, String, UInt64

class Talker(Node):
    def __init__(self, period=1.0):
        super().__init__('talker')
        self.publisher = self.create_publisher(UInt64, 'numbers', 10)
        self.count = 0
        self.create_timer(period, self.tick)

    def tick(self):
        self.count += 1
        self.publisher.publish(UInt64(data=self.count))

class Listener(Node):
    def __init__(self):
        super().__init__('listener')
        self.total = 0
        self.create_subscription(UInt64, 'numbers', self.got, 10)

    def got(self, message):
        self.total += message.data
        self.get_logger().info(f'total {self.total}')
"""


@pytest.fixture
def job_file(tmp_path: Path) -> Callable[..., Path]:
    """Write ``nodes_under_test.py`` and ``job.yaml`` and return the job's path."""

    def write(yaml: str, code: str = "") -> Path:
        (tmp_path / "nodes_under_test.py").write_text(TALKER + code)
        path = tmp_path / "job.yaml"
        path.write_text(yaml)
        return path

    return write


@pytest.fixture
def record_job(job_file: Callable[..., Path], tmp_path: Path) -> Callable[..., Any]:
    """Write a job and record it in this process; the result, with the error in it."""
    from rsltrace.job import load_job
    from rsltrace.run import run

    def go(yaml: str, code: str = "", output: str | None = "run.mcap") -> Any:
        job = load_job(job_file(yaml, code))
        return run(job, None if output is None else tmp_path / output, force=True)

    return go


@pytest.fixture
def rsltrace(tmp_path: Path, forks: Forks) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the command in a process of its own, in ``tmp_path``, and return what it did."""

    def call(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
        options.setdefault("cwd", tmp_path)
        env = {**os.environ, **options.pop("env", {})}
        words = [str(argument) for argument in arguments]
        if options.keys() == {"cwd"} and can_fork(words, env):
            return forks.run(words, options["cwd"], env, 300)
        return subprocess.run(
            [sys.executable, "-m", "rsltrace", *words],
            capture_output=True,
            text=True,
            timeout=300,
            env=env,
            check=False,
            **options,
        )

    return call
