"""The history of a suite: a line for each run, and what ``rsltrace history`` makes of them."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

SAMPLE = Path(__file__).parents[2] / "sample_traces" / "nondeterministic_callback"
A, B = SAMPLE / "a.mcap", SAMPLE / "b.mcap"
OLD, NEW = "1" * 40, "2" * 40
Command = Callable[..., subprocess.CompletedProcess[str]]
WriteJob = Callable[..., Path]


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def run(minute: int, job: str = "a.yaml", **more: Any) -> str:
    """Return a line of a history."""
    values = {
        "time": f"2026-11-01T10:{minute:02d}:00.000Z",
        "by": "verify",
        "job": job,
        "commit": OLD,
        "branch": "main",
        "digest": "a" * 16,
        "verdict": "passed",
    }
    return json.dumps({**values, **more}) + "\n"


@pytest.fixture(autouse=True)
def no_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GITHUB_SHA", "GITHUB_HEAD_REF", "GITHUB_REF_NAME"):
        monkeypatch.delenv(name, raising=False)
    for name in ("CI_COMMIT_SHA", "CI_COMMIT_REF_NAME", "RSLTRACE_HISTORY"):
        monkeypatch.delenv(name, raising=False)


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=Ada", "-c", "user.email=ada@example.org")
    done = subprocess.run(
        ["git", *who, *words], cwd=folder, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


@pytest.mark.long
@pytest.mark.ros
def test_verify_appends_a_line_with_commit_and_digest(
    rsltrace: Command, job: WriteJob, tmp_path: Path
) -> None:
    (tmp_path / "robot").mkdir()
    job("log('one')").rename(tmp_path / "robot" / "job.yaml")
    (tmp_path / "verified.py").rename(tmp_path / "robot" / "verified.py")
    git(tmp_path, "init", "-q", "-b", "main")
    git(tmp_path, "add", "robot")
    git(tmp_path, "commit", "-qm", "one")
    words = ("verify", "robot/job.yaml", "--runs", "2", "--history", "runs.jsonl")
    done = rsltrace(*words)
    assert done.returncode == 0, done.stderr
    (line,) = lines_of(tmp_path / "runs.jsonl")
    assert line["job"] == "robot/job.yaml"
    assert line["commit"] == git(tmp_path, "rev-parse", "HEAD")
    assert line["branch"] == "main"
    assert line["digest"] in done.stdout
    assert (line["by"], line["verdict"], line["runs"]) == ("verify", "passed", 2)
    assert line["seconds"] > 0


@pytest.mark.long
@pytest.mark.ros
def test_runs_of_two_commits_tell_what_changed_and_fails(
    rsltrace: Command, job: WriteJob, tmp_path: Path
) -> None:
    check = "checks: [never: 'log \"two\"']\n"
    job("log('one')", check)
    git(tmp_path, "init", "-q", "-b", "main")
    git(tmp_path, "add", "job.yaml", "verified.py")
    git(tmp_path, "commit", "-qm", "one")
    history = {"env": {**os.environ, "RSLTRACE_HISTORY": "runs.jsonl"}}
    assert rsltrace("verify", "job.yaml", "--runs", "2", **history).returncode == 0
    job("log('two')", check)
    explore = ("explore", "job.yaml", "--budget", "3", "--jobs", "1", "-q", "--force", "-o", "x")
    assert rsltrace(*explore, **history).returncode == 1
    git(tmp_path, "commit", "-qam", "two")
    assert rsltrace("verify", "job.yaml", "--runs", "2", **history).returncode == 0
    (tmp_path / "job.yaml").write_text("nodes: [{nod: x}]\n")
    assert rsltrace("verify", "job.yaml", **history).returncode == 2
    job("log(str(id(object())) + str({'a', 'b', 'c', 'd'}))", "guard: false\n")
    assert rsltrace("verify", "job.yaml", "--no-pin", **history).returncode == 1

    one, searched, two, broken, differs = lines_of(tmp_path / "runs.jsonl")
    commits = git(tmp_path, "rev-list", "HEAD").split()
    assert [one["commit"], two["commit"]] == commits[::-1]
    assert searched["commit"] == f"{commits[1]}-dirty"
    assert (searched["verdict"], searched["runs"], searched["failed"]) == ("failed", 3, 3)
    assert searched["reason"]
    assert searched["digest"] == two["digest"] != one["digest"]
    assert (broken["verdict"], broken["commit"]) == ("error", f"{commits[0]}-dirty")
    assert "unknown key 'nod'" in broken["reason"]
    assert differs["job"] == "job.yaml --no-pin"
    assert differs["verdict"] == "failed"
    assert "of /n" in differs["reason"]
    done = rsltrace("history", "runs.jsonl")
    assert "5 runs of 2 jobs at 4 commits" in done.stdout
    change = f"{one['digest']} → {two['digest']}  {commits[1][:10]}..{commits[1][:10]}-dirty"
    assert change in done.stdout
    assert "2 of 4 runs (50 %)  3 of 3 orders (100 %)" in done.stdout


def test_a_comparison_with_a_golden_trace_is_a_line(command: Command, tmp_path: Path) -> None:
    kept = ("--history", "runs.jsonl")
    assert command("diff", A, A, *kept).returncode == 0
    assert command("diff", A, B, A, *kept).returncode == 1
    assert command("diff", A, "gone.mcap", *kept).returncode == 2
    same, other, again, gone = lines_of(tmp_path / "runs.jsonl")
    assert same["job"].endswith("nondeterministic_callback/a.mcap")
    assert [one["verdict"] for one in (same, other, again, gone)] == [
        "passed",
        "failed",
        "passed",
        "error",
    ]
    assert same["digest"] == again["digest"] != other["digest"]
    assert other["reason"].startswith("/obstacle_filter: the callback for /scan at 2.1 s")
    assert "gone.mcap" in gone["reason"]
    assert same["commit"]  # of the repository of the trace, not of the working directory


def test_a_commit_is_that_of_ci_or_unknown(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.mcap").write_bytes(A.read_bytes())
    command("diff", "a.mcap", B, "--history", "runs.jsonl")
    monkeypatch.setenv("CI_COMMIT_SHA", NEW)
    monkeypatch.setenv("CI_COMMIT_REF_NAME", "fix")
    command("diff", "a.mcap", B, "--history", "runs.jsonl")
    unknown, of_ci = lines_of(tmp_path / "runs.jsonl")
    assert (unknown["commit"], unknown["branch"], unknown["job"]) == ("", "", "a.mcap")
    assert (of_ci["commit"], of_ci["branch"]) == (NEW, "fix")
    assert "last at 2222222222" in command("history", "runs.jsonl").stdout
    (tmp_path / "runs.jsonl").write_text(json.dumps(unknown) + "\n")
    assert "last at unknown" in command("history", "runs.jsonl").stdout


def test_a_folder_or_address_gets_a_file_for_each_run(command: Command, tmp_path: Path) -> None:
    for place in ("runs/", "runs", "memory://suite/runs"):
        assert command("diff", A, A, "--history", place).returncode == 0
    names = [path.suffix for path in (tmp_path / "runs").iterdir()]
    assert names == [".jsonl", ".jsonl"]
    read = command("history", "runs", "memory://suite/runs")
    assert read.stdout.startswith("3 runs of 1 job"), read.stderr
    assert "no .jsonl files" in command("history", "memory://nothing").stderr
    read = command("diff", A, A, "--history", "no-such-scheme://user:secret@x")
    assert read.returncode == 2
    assert "secret" not in read.stderr


def test_a_folder_of_a_web_server_is_read(command: Command, tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    for number in range(3):
        (tmp_path / "runs" / f"{number}.jsonl").write_text(run(number))
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/runs"
        done = command("history", f"{address}/", f"{address}/1.jsonl")
        kept = command("diff", A, A, "--history", address)
        server.shutdown()
    assert done.stdout.startswith("4 runs of 1 job"), done.stderr
    assert kept.returncode == 2
    assert "cannot be written: 501" in kept.stderr
    gone = command("history", f"{address}/").stderr
    assert f"{address}/ cannot be read: Cannot connect" in gone


def test_what_is_no_place_for_a_history_is_refused_before_the_run(
    command: Command, tmp_path: Path
) -> None:
    (tmp_path / "job.yaml").write_text("nodes: []\n")
    for place in ("/dev/null", "job.yaml/x"):
        done = command("verify", "job.yaml", "--history", place)
        assert done.returncode == 2
        assert f"the history {place} cannot be written" in done.stderr
    for place, why in (("gone.jsonl", "gone.jsonl"), (tmp_path, "no .jsonl files")):
        done = command("history", place)
        assert done.returncode == 2
        assert why in done.stderr


APPEND = """
import sys
from pathlib import Path
from rsltrace.search.history.run_record import recorded
for number in range(int(sys.argv[2])):
    words = [f"{sys.argv[3]} {number}" * 40]
    with recorded(sys.argv[1], "verify", Path(), lambda path: words) as run:
        run.fails("x" * 4000)
"""


@pytest.mark.parametrize("count", [3, pytest.param(150, marks=pytest.mark.long)])
def test_processes_lose_and_break_no_line(count: int, tmp_path: Path, command: Command) -> None:
    history = tmp_path / "runs.jsonl"
    history.write_text(run(0) + '{"time":"2026-1')  # and one was killed while it wrote

    def append(name: str) -> None:
        words = [sys.executable, "-c", APPEND, str(history), str(count), name]
        subprocess.run(words, check=True, timeout=600, cwd=tmp_path)

    names = ("one", "two", "three", "four")
    with ThreadPoolExecutor() as pool:
        list(pool.map(append, names))
    _, torn, *lines = history.read_text().splitlines()
    assert torn == '{"time":"2026-1'
    jobs = [json.loads(line)["job"].count(name) for line in lines for name in names]
    assert sum(map(bool, jobs)) == len(lines) == 4 * count
    done = command("history", "runs.jsonl")
    assert f"{4 * count + 1} runs" in done.stdout
    assert "runs.jsonl:2: skipped" in done.stderr


BAD = (
    '{"time":"2026-11-01T10:00:00.000Z","by":"verify","job":"a.yaml","verd',
    "",
    "[]",
    "[" * 1000,
    run(1, job=5),
    run(1, verdict="good"),
    run(1, digest="xyz"),
    run(1, runs=1 << 70),
    run(1, failed=-1),
    run(1, time="2026-11-01"),
    run(1).replace('"main"', '"\\ud800"'),
    run(1, seconds=float("nan")),
    run(1, reason="x" * 100_000),
)


def test_lines_that_are_none_are_named_and_skipped(command: Command, tmp_path: Path) -> None:
    lines = [run(0), *(line.rstrip("\n") + "\n" for line in BAD[1:]), run(2, added=1), BAD[0]]
    (tmp_path / "runs.jsonl").write_text("".join(lines))
    done = command("history", "runs.jsonl")
    assert done.returncode == 0
    assert done.stdout.startswith("2 runs of 1 job at 1 commit")
    for number in range(2, 12):
        assert f"warning: runs.jsonl:{number}: skipped, it is cut off or not" in done.stderr
    assert f"{len(BAD) - 10} more lines were skipped" in done.stderr
    assert json.loads(command("history", "runs.jsonl", "--json").stdout)["skipped"] == len(BAD)
    (tmp_path / "runs.jsonl").write_text(f"{run(0)}{BAD[0]}")
    assert "runs.jsonl:2: skipped" in command("history", "runs.jsonl").stderr


def test_dates_that_are_none_end_nothing(command: Command, tmp_path: Path) -> None:
    line = run(0, time="9999-19-39T99:99:99.999Z")
    (tmp_path / "runs.jsonl").write_text(line + run(1, time="0000-00-00T00:00:00.000Z"))
    assert command("history", "runs.jsonl", "--json").returncode == 0


def test_digests_are_compared_on_each_branch_in_the_order_of_time(
    command: Command, tmp_path: Path
) -> None:
    """Whatever the order of lines and files."""
    (tmp_path / "one.jsonl").write_text(
        run(3, commit=NEW, digest="b" * 16)
        + run(2, branch="fix", digest="c" * 16)
        + run(4, commit=NEW, digest="", verdict="error", reason="crashed")
    )
    (tmp_path / "two.jsonl").write_text(run(1) + run(5, commit=NEW, digest="d" * 16))
    done = command("history", "one.jsonl", "two.jsonl")
    assert done.stdout.splitlines()[2:5] == [
        "digest changed:",
        "2026-11-01 10:05  a.yaml  main  bbbbbbbbbbbbbbbb → dddddddddddddddd  2222222222: the same "
        "commit",
        "2026-11-01 10:03  a.yaml  main  aaaaaaaaaaaaaaaa → bbbbbbbbbbbbbbbb  "
        "1111111111..2222222222",
    ]
    assert "next:" not in done.stdout  # there is no such job here
    (tmp_path / "a.yaml").touch()
    done = command("history", "one.jsonl", "two.jsonl")
    assert "next: rsltrace bisect a.yaml --good 1111111111 --bad 2222222222\n" in done.stdout
    done = command("history", "one.jsonl", "two.jsonl", "--branch", "f*")
    assert done.stdout.startswith("1 run of 1 job")
    done = command("history", "one.jsonl", "two.jsonl", "--since", "2026-11-02")
    assert done.stdout == "no runs\n"
    (tmp_path / "job.yaml").write_text("nodes: []\n")
    done = command("history", "job.yaml")
    assert (done.returncode, "job.yaml: no line of a history" in done.stderr) == (2, True)
    done = command("history", "one.jsonl", "two.jsonl", "--job", "b*", "-o", "page.html")
    assert "no runs" in (tmp_path / "page.html").read_text()


def test_a_job_fails_now_until_its_runs_and_its_searches_pass(
    command: Command, tmp_path: Path
) -> None:
    def failing(*lines: str) -> int:
        (tmp_path / "runs.jsonl").write_text("".join(lines))
        values = json.loads(command("history", "runs.jsonl", "--json").stdout)
        assert [one["fails_now"] for one in values["jobs"]] == [bool(values["jobs_failing_now"])]
        return int(values["jobs_failing_now"])

    bad = run(1, verdict="failed")
    searched = {"by": "explore", "runs": 10}
    assert failing(bad) == 1
    assert failing(run(2), bad) == 0
    assert failing(run(2), run(1, verdict="failed", failed=1, **searched)) == 1
    assert failing(run(2), bad, run(1, verdict="failed", **searched), run(3, **searched)) == 0


MEASURE = """
import json, resource, sys
from rsltrace.search.history.summary import summarize
found = summarize([sys.argv[1]])
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps([found.runs, found.changes_count, found.failed, found.orders,
                  [one.failed for one in sorted(found.jobs, key=lambda one: one.job)], peak]))
"""


def simulated(path: Path, count: int) -> tuple[int, list[int]]:
    """Write the lines of a fleet; return the changes of digests, and failures by job."""
    drawn = random.Random(1)
    jobs = [f"robots/{number:02d}/job.yaml" for number in range(50)]
    digests = {job: f"{number:016x}" for number, job in enumerate(jobs, 1)}
    changes, failed = 0, [0] * len(jobs)
    with path.open("w") as file:
        for number in range(count):
            which = number % len(jobs)
            job, bad = jobs[which], drawn.random() < 0.01
            failed[which] += bad
            if number >= len(jobs) and drawn.random() < 0.001:
                digests[job] = f"{number + 1000:016x}"
                changes += 1
            hours, rest = divmod(number, 3600)
            day, hour = divmod(hours, 24)
            clock = f"{hour:02d}:{rest // 60:02d}:{rest % 60:02d}"
            file.write(
                f'{{"time":"2026-11-{day + 1:02d}T{clock}.000Z",'
                f'"by":"explore","job":"{job}","commit":"{number // 50:040x}","branch":"main",'
                f'"digest":"{digests[job]}","verdict":"{"failed" if bad else "passed"}",'
                f'"reason":"{"the cart stays where it has stopped" * bad}","seconds":1.5,'
                f'"runs":100,"failed":{int(bad)}}}\n'
            )
    return changes, failed


@pytest.mark.long
def test_a_million_lines_have_the_right_answer_in_little_memory(tmp_path: Path) -> None:
    peaks = []
    for count in (10_000, 1_000_000):
        changes, failed = simulated(tmp_path / "runs.jsonl", count)
        done = subprocess.run(
            [sys.executable, "-c", MEASURE, str(tmp_path / "runs.jsonl")],
            check=True,
            capture_output=True,
            text=True,
        )
        *answer, peak = json.loads(done.stdout)
        assert answer == [count, changes, sum(failed), 100 * count, failed]
        peaks.append(peak)
    assert peaks[1] - peaks[0] < 120 << 10  # KiB, of lines with 250 MB


def test_what_is_written_can_be_read_whatever_the_names_are(
    command: Command, tmp_path: Path
) -> None:
    odd = os.fsdecode(b"a \xff\x1b\n.mcap")
    (tmp_path / odd).write_bytes(A.read_bytes())
    assert command("diff", odd, B, "--history", "runs.jsonl").returncode == 1
    done = command("history", "runs.jsonl", "--json")
    assert done.stderr == ""
    assert json.loads(done.stdout)["jobs"][0]["job"] == r"'a \udcff\x1b\n.mcap'"
