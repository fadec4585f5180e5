"""The record command where terminals, pipes and options are not as one would like."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

JOB = """
nodes:
  - {node: nodes_under_test:Talker, arguments: {period: 0.01}}
  - node: nodes_under_test:Listener
stop: {duration: 20s}
"""


@pytest.mark.parametrize("redirect", ["2>&-", "2>&1 >/dev/null | head -1"])
def test_nobody_has_to_listen_to_the_nodes(
    job_file: Callable[..., Path], rsltrace: Any, tmp_path: Path, redirect: str
) -> None:
    job_file(JOB)
    done = rsltrace("record", "job.yaml", "-o", "quiet.mcap", "--quiet")
    assert done.returncode == 0
    command = f"{sys.executable} -m rsltrace record job.yaml -o loud.mcap"
    subprocess.run(f"{command} {redirect}", shell=True, cwd=tmp_path, check=False, timeout=60)
    assert (tmp_path / "loud.mcap").read_bytes() == (tmp_path / "quiet.mcap").read_bytes()


@pytest.mark.parametrize("until", ["x", "-3", "", "nan"])
def test_a_bad_until_is_named_as_it_was_typed(
    job_file: Callable[..., Path], rsltrace: Any, until: str
) -> None:
    job_file(JOB)
    done = rsltrace("record", "job.yaml", "--until", until)
    assert done.returncode == 2
    assert done.stderr.startswith("rsltrace: error: --until: ")
