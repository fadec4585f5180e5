"""``rsltrace verify``: one digest, or the two runs that differ and what made them differ."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, cast

import pytest

from rsltrace.child_processes import Done
from rsltrace.cli import verify as verify_command
from rsltrace.search import perturb
from rsltrace.search.perturb import KINDS, Perturbation, PerturbedRun, perturbation, perturbed_run
from rsltrace.search.verify import DeterminismTest, VerifyResult

pytestmark = pytest.mark.ros

ORDER_OF_A_SET = "log(' '.join({'a', 'b', 'c', 'd', 'e', 'f'}))"
AS_IT_IS = "guard: {order: allow}\n"
Command = Callable[..., subprocess.CompletedProcess[str]]
WriteJob = Callable[..., Path]


def test_surroundings_differ_from_run_to_run_and_not_from_time_to_time() -> None:
    assert perturbation(0).values == {}
    assert perturbation(3) == perturbation(3)
    assert perturbation(3).values != perturbation(4).values != perturbation(4, seed=1).values
    assert set(perturbation(1).values) <= set(KINDS)
    assert list(perturbation(1).only(KINDS[0]).values) == [KINDS[0]]


def test_a_core_type_that_the_user_has_chosen_is_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(perturb, "core_types", lambda: ("Nehalem", "Haswell"))
    monkeypatch.delenv(perturb.CORE_TYPE, raising=False)
    assert perturb.KERNEL in perturbation(1).values
    monkeypatch.setenv(perturb.CORE_TYPE, "Haswell")
    values = perturbation(1).values
    assert perturb.KERNEL not in values
    assert perturb.THREAD_COUNT in values


def test_of_a_core_type_that_makes_a_difference_the_way_out_is_named() -> None:
    found = VerifyResult(cast(Any, None), 2, (), (), narrowed=True, provoked_by=(perturb.KERNEL,))
    told = verify_command._provoked(found, "rsltrace verify job.yaml --run 1")
    assert "OPENBLAS_CORETYPE=Haswell rsltrace" in told
    other = replace(found, provoked_by=(perturb.HEAP,))
    assert "CORETYPE" not in verify_command._provoked(other, "rsltrace verify job.yaml --run 1")


@pytest.mark.long
def test_one_digest_is_stated_as_what_was_tried(
    rsltrace: Command, job: WriteJob, tmp_path: Path
) -> None:
    kinds = perturbation(1).values
    asks = ORDER_OF_A_SET + ", print('Input {x}: ', end='')"  # where the result is printed, too
    # Relative paths lead to what they lead to in ``record``; what a run writes stays its own.
    (tmp_path / "gains").mkdir()
    (tmp_path / "gains" / "p.txt").write_text("7")
    asks += f", [log(open(f).read()) for f in ('gains/p.txt', '../{tmp_path.name}/gains/p.txt')]"
    asks += ", open('new.txt', 'x').close() if not os.path.exists('new.txt') else None"
    done = rsltrace("verify", job(asks, AS_IT_IS), "--runs", "3", "--jobs", "2")
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    assert first.startswith(f"3 runs, {len(kinds)} perturbations, one digest ")
    assert "hash seed" in second
    assert not (tmp_path / "new.txt").exists()


@pytest.mark.long
def test_what_differs_and_is_not_published_is_found_in_the_run_in_which_it_begins(
    rsltrace: Command, job: WriteJob
) -> None:
    made = job("self.drawn = random.random()", "guard: {random: allow}\n")
    module = made.parent / "verified.py"
    module.write_text("import random\n" + module.read_text())
    done = rsltrace("verify", made, "--runs", "2")
    assert done.returncode == 0, done.stderr
    first, _, _, *lines = done.stdout.splitlines()
    assert "one digest" in first
    assert lines[0].startswith("The events agree, but the state of /n differs: its attribute drawn")
    assert lines[1].startswith("cause: not a perturbation")
    assert "drawn  0." in done.stdout  # both values
    assert "(verified.py:" in done.stdout
    assert "report it" not in done.stdout  # the job lets it pass
    told = json.loads(rsltrace("verify", made, "--runs", "2", "--json").stdout)
    assert told["agrees"]
    assert told["hidden"]["attribute"] == "drawn"


def test_what_provokes_other_events_is_found_beside_states_that_always_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    number = count()

    def record(around: Perturbation) -> PerturbedRun:
        digest = around.values.get(perturb.TIME_ZONE, "")
        return PerturbedRun(around, tmp_path / "x", digest or "-", 1, 0, "", "", str(next(number)))

    series = DeterminismTest((), tmp_path)
    monkeypatch.setattr(series, "_record", record)
    first, other = record(perturbation(0)), record(perturbation(1))
    found = series._narrowed(VerifyResult(first, 2, (), (), other=other), 0.1)
    assert (found.by_itself, found.provoked_by) == (False, (perturb.TIME_ZONE,))


@pytest.mark.long
def test_a_hidden_difference_has_the_commands_that_repeat_it(
    rsltrace: Command, job: WriteJob
) -> None:
    made = job("self.order = list({'a', 'b', 'c', 'd', 'e', 'f'})", AS_IT_IS)
    done = rsltrace("verify", made, "--runs", "2", "--no-pin")
    assert done.returncode == 0, done.stderr
    assert "the state of /n differs: its attribute order" in done.stdout
    assert "caused by: hash seed alone" in done.stdout
    assert "--run 1 --only 'hash seed'" in done.stdout


@pytest.mark.parametrize("before", ["", "Input x: ", '{"digest": 1\n{"', "many\nlines {}\n"])
@pytest.mark.parametrize("after", ["\n", "", " bye", '\nbye {"\n{"a": 1}\n'])
def test_the_result_is_found_in_what_nodes_print(before: str, after: str) -> None:
    result = {
        "digest": "12ab",
        "events": 7,
        "error": None,
        "path": "o.mcap",
        "more": {"a": {"": 1}},
    }
    done = Done(0, before + json.dumps(result) + after, "")
    found = perturbed_run(perturbation(0), Path("run.mcap"), done)
    assert (found.digest, found.events, found.path, found.failure) == (
        "12ab",
        7,
        Path("o.mcap"),
        "",
    )


def test_a_run_without_a_result_has_failed() -> None:
    found = perturbed_run(perturbation(0), Path("run.mcap"), Done(0, 'no {"digest": result', ""))
    assert found.failure == "it ended with exit status 0 and no trace"


@pytest.mark.long
def test_without_the_pin_the_hash_seed_shows(
    rsltrace: Command, job: WriteJob, tmp_path: Path
) -> None:
    options = ("--runs", "6", "--no-pin", "--keep", "kept", "--until", "1")
    done = rsltrace("verify", job(ORDER_OF_A_SET, AS_IT_IS), *options)
    assert done.returncode == 1, done.stderr
    assert "not deterministic" in done.stdout
    assert "caused by: hash seed alone" in done.stdout
    assert "environment: hash_seed  0" in done.stdout, "the diff is printed"
    page = (tmp_path / "kept/report.html").read_text()
    assert f"<h1>{done.stdout.splitlines()[0]}</h1>" in page
    assert "environment: hash_seed" in page
    lines = done.stdout.splitlines()
    for number in (0, 1):
        (at,) = (n for n, line in enumerate(lines) if line.startswith(f"run {number}: digest "))
        digest = lines[at].split()[3].rstrip(":")
        again = rsltrace(*shlex.split(lines[at + 1].strip())[1:])
        assert again.stdout.startswith(f"digest {digest} "), again.stderr
        assert (tmp_path / f"run-{number}.mcap").read_bytes() == (
            tmp_path / f"kept/run-{number}.mcap"
        ).read_bytes()
    narrow = lines[lines.index("caused by: hash seed alone") + 1]
    assert rsltrace(*shlex.split(narrow)[1:]).stdout.startswith(f"digest {digest} ")


@pytest.mark.long
def test_a_job_that_differs_by_itself_is_told_so(rsltrace: Command, job: WriteJob) -> None:
    path = job("log(str(time.time_ns()))", "guard: false\n")
    done = rsltrace("verify", path, "--runs", "3", "--json")
    assert done.returncode == 1, done.stderr
    result = json.loads(done.stdout)
    assert result["by_itself"] is True
    assert result["agrees"] is False
    assert len(result["digests"]) == 2
    assert result["diff"]["verdict"] == "same-input-different-output"


@pytest.mark.long
def test_a_job_that_fails_is_trouble(rsltrace: Command, job: WriteJob) -> None:
    done = rsltrace("verify", job("raise ValueError('bad')"))
    assert done.returncode == 2
    assert "ValueError: bad" in done.stderr
    assert "--run 0" in done.stderr
    missing = rsltrace("verify", "nothing.yaml")
    assert missing.returncode == 2
    assert "there is no such job file" in missing.stderr


@pytest.mark.long
def test_a_run_that_crashes_is_trouble_and_says_where(rsltrace: Command, job: WriteJob) -> None:
    crash = (
        "os.getcwd().endswith('x') and "
        "(print('woe', file=sys.stderr, flush=True), ctypes.string_at(0))"
    )
    done = rsltrace("verify", job(crash), "--runs", "3")
    assert done.returncode == 2, done.stdout
    assert "run 1 of" in done.stderr
    assert "it was killed by SIGSEGV" in done.stderr
    assert "| woe" in done.stderr


@pytest.mark.long
def test_a_run_that_hangs_is_killed(rsltrace: Command, job: WriteJob) -> None:
    hang = "os.getcwd().endswith('x') and signal.pause()"
    done = rsltrace("verify", job(hang), "--runs", "2", "--timeout", "20", timeout=300)
    assert done.returncode == 2, done.stdout
    assert "took too long" in done.stderr


@pytest.mark.long
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_leaves_nothing_behind(
    job: WriteJob, tmp_path: Path, number: int, status: int
) -> None:
    path = job("open('/dev/null'); open(os.environ['HERE'], 'a').write('x'); signal.pause()")
    here = tmp_path / "temporary"
    here.mkdir()
    mark = tmp_path / "mark"
    env = {**os.environ, "TMPDIR": str(here), "HERE": str(mark)}
    command = [sys.executable, "-m", "rsltrace", "verify", str(path)]
    with subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True) as process:
        while not mark.exists() and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(number)
        process.communicate(timeout=300)
    assert process.returncode == status
    assert list(here.iterdir()) == []
    assert not _processes_with(f"HERE={mark}"), "what it has started is gone"


def _processes_with(text: str) -> list[str]:
    found = []
    for environ in Path("/proc").glob("[0-9]*/environ"):
        try:
            if text.encode() in environ.read_bytes():
                found.append(environ.parent.name)
        except OSError:
            continue
    return found


@pytest.mark.long
def test_what_record_takes_verify_takes(rsltrace: Command, job: WriteJob, tmp_path: Path) -> None:
    job("log(str(self.declare_parameter('rate', 0).value) + os.environ.get('X', ''))")
    (tmp_path / "more.yaml").write_text("n: {ros__parameters: {rate: 7}}\n")
    words: tuple[Any, ...] = (
        "job.yaml", "--seed", "5", "--set", "stop.duration=2s", "--until", "1",
        "--ros-args", "--params-file", "more.yaml", "--",
    )  # fmt: skip
    perturbed_run = rsltrace("record", *words, "-o", "run.mcap")
    assert "] [n]: 7" in perturbed_run.stderr
    digest = perturbed_run.stdout.split()[1]
    done = rsltrace("verify", *words, "--runs", "2")
    assert f"one digest {digest}" in done.stdout, done.stderr
