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


@pytest.mark.few(1)
@pytest.mark.parametrize("redirect", ["2>&-", ">&- 2>&-", "2>&1 >/dev/null | head -1"])
def test_nobody_has_to_listen_to_the_nodes(
    job_file: Callable[..., Path], rsltrace: Any, tmp_path: Path, redirect: str
) -> None:
    job_file(JOB)
    done = rsltrace("record", "job.yaml", "-o", "quiet.mcap", "--quiet")
    assert done.returncode == 0
    command = f"{sys.executable} -m rsltrace record job.yaml -o loud.mcap"
    subprocess.run(f"{command} {redirect}", shell=True, cwd=tmp_path, check=False, timeout=300)
    assert (tmp_path / "loud.mcap").read_bytes() == (tmp_path / "quiet.mcap").read_bytes()


@pytest.mark.parametrize("until", ["x", "-3", "", "nan"])
def test_a_bad_until_is_named_as_it_was_typed(
    job_file: Callable[..., Path], command: Any, until: str
) -> None:
    job_file(JOB)
    done = command("record", "job.yaml", "--until", until)
    assert done.returncode == 2
    assert done.stderr.startswith("rsltrace: error: --until: ")


def test_two_nodes_of_one_name_are_told(job_file: Callable[..., Path], command: Any) -> None:
    job_file("nodes: [{node: nodes_under_test:Listener}, {node: nodes_under_test:Listener}]\n")
    done = command("record", "job.yaml", "--until", "1s")
    assert done.returncode == 0
    assert "[rcl.logging_rosout]: Publisher already registered for node name: 'listener'" in (
        done.stderr
    )
    assert "note: several nodes are named /listener" in done.stderr
    done = command("check", "job.yaml")
    assert "2 nodes are named /listener" in done.stdout


def test_a_number_without_end_is_not_printed_in_full(
    job_file: Callable[..., Path], command: Any
) -> None:
    job_file(f"nodes: [{{node: nodes_under_test:Listener}}]\nseed: {'9' * 5000}\n")
    done = command("record", "job.yaml")
    assert done.returncode == 2
    assert "...' is too long a number" in done.stderr
    assert len(done.stderr) < 500


def test_a_recording_is_no_job(job_file: Callable[..., Path], command: Any) -> None:
    job_file(JOB)
    assert command("record", "job.yaml", "--until", "0.1", "-o", "run.mcap").returncode == 0
    done = command("record", "run.mcap")
    assert done.returncode == 2
    assert "run.mcap: this is a recording, not a job file" in done.stderr


@pytest.mark.parametrize("key", ["base", "include"])
def test_other_files_are_not_named_on_the_command_line(
    job_file: Callable[..., Path], command: Any, key: str
) -> None:
    job_file(JOB)
    done = command("check", "job.yaml", "--set", f"{key}=other.yaml")
    assert done.returncode == 2, "it would be left out in silence"
    assert f"--set: {key}: is read before the command line is" in done.stderr


def test_a_module_is_no_job(job_file: Callable[..., Path], command: Any) -> None:
    job_file("nodes: []\n")
    done = command("record", "nodes_under_test.py")
    assert done.returncode == 2
    assert done.stderr == (
        "rsltrace: error: nodes_under_test.py: this is Python, not a job file; "
        "`rsltrace init --from nodes_under_test.py` writes one\n"
    )
    job_file("nodes: [{node: '../nodes_under_test.py:Talker'}]\n")
    done = command("record", "job.yaml")
    assert "add .. to search_path and write nodes_under_test:Talker\n" in done.stderr


def test_a_command_that_is_misspelt(command: Any) -> None:
    done = command("recrod", "job.yaml")
    assert done.returncode == 2
    assert done.stderr.endswith("Error: No such command 'recrod'. Did you mean 'record'?\n")
    assert command("xyzzy").stderr.endswith("Error: No such command 'xyzzy'.\n")


def test_a_job_without_an_end_says_so(job_file: Callable[..., Path], command: Any) -> None:
    """It runs until somebody stops it, here the node; one that is told when does not say it."""
    code = """
class Weary(Talker):
    def tick(self):
        super().tick()
        assert self.count < 3
"""
    job_file("nodes: [{node: 'nodes_under_test:Weary'}]\n", code)
    note = "note: the job has no end: stop the run with 'stop:' in the job, --until T or Ctrl-C"
    endless = command("record", "job.yaml", "-o", "run.mcap")
    assert (endless.returncode, note in endless.stderr) == (3, True)
    assert note not in command("record", "job.yaml", "--until", "1", "-o", "2.mcap").stderr
