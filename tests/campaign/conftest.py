"""Job files with one small node, and the command in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

NODE = """
import ctypes, os, signal, sys, time, uuid
from rclpy.node import Node
class N(Node):
    def __init__(self):
        super().__init__('n')
        self.create_timer(1.0, self.tick)
    def tick(self):
        log = self.get_logger().info
        LINE
"""


@pytest.fixture
def job(tmp_path: Path) -> Callable[..., Path]:
    """Write a job whose node does ``line`` each second, for one second; ``more`` is YAML."""

    def write(line: str, more: str = "") -> Path:
        (tmp_path / "verified.py").write_text(NODE.replace("LINE", line))
        path = tmp_path / "job.yaml"
        path.write_text("nodes: [{node: 'verified:N'}]\nstop: {duration: 1s}\n" + more)
        return path

    return write


@pytest.fixture
def rsltrace(tmp_path: Path) -> Callable[..., Any]:
    def run(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "rsltrace", *map(str, words)]
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, check=False, **options
        )

    return run
