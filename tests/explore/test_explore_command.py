"""``rsltrace explore``: what it finds, what it keeps when killed, and what it says is wrong."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.search.explore.table import result_rows

CHECKED = """\
nodes:
  - {node: nodes_under_search:Sender, name: one, parameters: {value: 1, topic: a}}
  - {node: nodes_under_search:Sender, name: two, parameters: {value: 2, topic: b}}
  - {node: nodes_under_search:Last}
stop: {duration: 0.25s}
checks: [{name: the second comes last, never: "/last: data == 1"}]
metrics: {said: count("/last")}
"""
BAD = "nodes: [{node: nodes_under_search:Bad, parameters: {how: HOW}}]\nstop: {duration: 0.15s}\n"


def test_a_failing_order_is_found_and_repeated_by_the_command_that_is_printed(
    write_job: Callable[[str, str], Path], tmp_path: Path, command: Callable[..., Any]
) -> None:
    job, folder = write_job("checked", CHECKED), tmp_path / "found"
    done = command("explore", job, "--budget", 60, "--jobs", 1, "--stop-at-first", "-o", folder)
    assert done.returncode == 1, done.stderr
    assert "check: the second comes last: /last: data == 1" in done.stdout
    found = [one for one in result_rows(folder) if one.failure is not None]
    assert found[0].failure.key == "the second comes last"
    again = shlex.split(re.search(r"reproduce: rsltrace (.*)", done.stdout)[1])
    (tmp_path / "found.mcap").touch()
    repeated = command(*again)
    assert repeated.returncode == 1, repeated.stderr
    assert f"digest {found[0].digest}  events {found[0].events}" in repeated.stdout
    assert Path(found[0].trace).is_file()
    assert found[0].metrics == {"said": 2.0}
    assert b"the second comes last" in (folder / "report.html").read_bytes()
    shown = command("explore", job, "--budget", 1, "--resume", "--format", "json", "-o", folder)
    assert json.loads(shown.stdout)["causes"][0]["key"] == "the second comes last"
    refused = command("explore", job, "--budget", 60, "-o", folder)
    assert refused.returncode == 2
    assert "--resume continues it" in refused.stderr
    other = command("explore", job, "--resume", "--strategy", "pct", "-o", folder)
    assert "has a different search (strategy differs)" in other.stderr
    (folder / "mine.txt").touch()
    words = ["--set", "checks=[]", "--budget", 1, "--force"]
    replaced = command("explore", job, *words, "-o", folder)
    assert replaced.returncode == 0, replaced.stderr
    assert "the job has no checks: only exceptions" in replaced.stdout
    assert sorted(path.name for path in (folder / "traces").iterdir()) == ["000000.mcap"]
    assert len(list(result_rows(folder))) == 1
    assert (folder / "mine.txt").exists()


@pytest.mark.long
@pytest.mark.parametrize("how", ["raises", "dies", "hangs"])
def test_what_becomes_of_runs_that_do_not_end_well(
    write_job: Callable[[str, str], Path], tmp_path: Path, command: Callable[..., Any], how: str
) -> None:
    job, folder = write_job(how, BAD.replace("HOW", how)), tmp_path / "bad"
    timeout = ["--timeout", "5"] if how == "hangs" else []
    done = command("explore", job, "--budget", 2, "--jobs", 1, "-o", folder, *timeout)
    assert done.returncode == 1
    failures = [one.failure for one in result_rows(folder)]
    kind, key = {
        "raises": ("exception", r"ValueError at nodes_under_search.py:\d+"),
        "dies": ("crash", "crash: SIGSEGV"),
        "hangs": ("timeout", "timeout"),
    }[how]
    assert [one.kind for one in failures] == [kind, kind]
    assert all(re.fullmatch(key, one.key) for one in failures)
    assert "the job fails in its default order" in done.stdout


@pytest.mark.long
def test_a_search_that_is_killed_goes_on_where_it_was(
    write_job: Callable[[str, str], Path], tmp_path: Path
) -> None:
    job, folder = write_job("killed", CHECKED), tmp_path / "killed"
    words = ["explore", str(job), "--budget", "24", "--jobs", "2", "-o", str(folder), "-q"]
    words = [sys.executable, "-m", "rsltrace", *words]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    table = folder / "results.jsonl"
    _wait_for_rows(table, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = table.read_bytes()
    with table.open("ab") as file:
        file.write(b'{"trial":{"num')  # as a kill in the middle of a row would
    done = subprocess.run([*words, "--resume"], capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert table.read_bytes().startswith(before)
    assert "PCT:" not in done.stdout, "-q: the result alone"
    numbers = [json.loads(line)["trial"]["number"] for line in table.read_text().splitlines()]
    assert sorted(numbers) == list(range(24))


def _wait_for_rows(table: Path, process: subprocess.Popen[Any]) -> None:
    ended = False
    while not table.exists() or table.read_bytes().count(b"\n") < 6:
        assert not ended
        time.sleep(0.02)
        ended = process.poll() is not None  # before one looks: what it wrote at last counts


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_search_that_is_ended_says_what_it_found(
    write_job: Callable[[str, str], Path], tmp_path: Path, number: signal.Signals
) -> None:
    job, folder = write_job("ended", CHECKED), tmp_path / "ended"
    words = ["explore", str(job), "--budget", "10000", "-o", str(folder)]
    command = [sys.executable, "-m", "rsltrace", *words]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        _wait_for_rows(folder / "results.jsonl", process)
        process.send_signal(number)
        found, told = process.communicate(timeout=600)
    assert process.returncode == 128 + number
    assert f"interrupted: continue with --resume; the results are in {folder}" in told
    assert f"results: {folder}; report: {folder / 'report.html'}" in found


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--budget", "0"], "the budget must be greater than 0"),
        (["--budget", "soon"], "expected a number of runs (1000) or a time (10min"),
        (["--resume"], "there is no search to resume"),
        (["--set", "checks.+={never: nothing}"], "never"),
        pytest.param(
            ["--set", "nodes.0.node=nodes_under_search:Nobody"], "Nobody", marks=pytest.mark.long
        ),
    ],
)
def test_what_cannot_be_searched_is_said(
    write_job: Callable[[str, str], Path],
    tmp_path: Path,
    command: Callable[..., Any],
    words: list[str],
    says: str,
) -> None:
    job = write_job("wrong", CHECKED)
    done = command("explore", job, "--jobs", 1, "-o", tmp_path / "wrong", *words)
    assert done.returncode == 2
    assert says in done.stderr
    assert "Traceback" not in done.stderr
