"""A failing run is made small, and its folder reproduces it wherever it lies."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.small.causes import write_small
from rsltrace.search.explore.small.reduction import ReducedTrial, TrialReduction, ddmin
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult
from rsltrace.search.explore.workers import Worker
from rsltrace.trace.reader import Trace

# -- delta debugging -----------------------------------------------------------------------------

sets_of_causes = st.lists(st.sets(st.integers(0, 19), max_size=5), min_size=1, max_size=3)


@given(st.integers(1, 20), sets_of_causes)
def test_what_is_left_fails_and_nothing_of_it_can_be_left_out(
    count: int, causes: list[set[int]]
) -> None:
    """It fails whenever all of one set of causes are there: monotonic, so 1-minimal is minimal."""
    items = list(range(count))
    asked: list[tuple[int, ...]] = []

    def fails(some: list[int]) -> bool:
        asked.append(tuple(some))
        return any(cause <= set(some) for cause in causes)

    if not fails(items):
        return
    asked.clear()
    found = ddmin(items, fails)
    assert found == sorted(found)
    assert any(cause == set(found) for cause in causes)
    assert len(asked) == len(set(asked)) <= count**2 + 3 * count + 1
    assert tuple(items) not in asked


@given(st.data())
def test_it_is_one_minimal_whatever_fails(data: st.DataObject) -> None:
    items = list(range(data.draw(st.integers(1, 7))))
    answers: dict[tuple[int, ...], bool] = {tuple(items): True}

    def fails(some: list[int]) -> bool:
        key = tuple(some)
        if key not in answers:
            answers[key] = data.draw(st.booleans())
        return answers[key]

    found = ddmin(items, fails)
    assert answers[tuple(found)]
    for left_out in found:
        assert not fails([one for one in found if one != left_out])


def test_one_cause_among_many_is_found_by_halving() -> None:
    asked = 0

    def fails(some: list[int]) -> bool:
        nonlocal asked
        asked += 1
        return 700 in some

    assert ddmin(range(1024), fails) == [700]
    assert asked <= 2 * 10 + 2


# -- a trial -------------------------------------------------------------------------------------

ORDER_JOB = """\
nodes:
  - {node: nodes_under_search:Sender, name: idle, parameters: {topic: c}}
  - {node: nodes_under_search:Sender, name: one, parameters: {value: 1, topic: a}}
  - {node: nodes_under_search:Sender, name: two, parameters: {value: 2, topic: b}}
  - {node: nodes_under_search:Last, parameter_files: [more/last.yaml]}
search_path: [., more]
stop: {duration: 0.65s}
checks: [{name: two is last, always: /last.data == 2}]
"""
END_JOB = """\
base: job.yaml
checks: [{name: six came, function: "at_the_end:six_came"}]
"""
AT_THE_END = """\
def six_came(trace):
    said = [trace.decode("/last", data).data for _, _, data in trace.messages("/last")]
    return said.count(2) >= 6
"""
FAULTS = [
    {"delay": "/a", "message": 1, "by": "10ms"},
    {"drop": "/b", "message": 3},
    {"crash": "/idle", "at": "0.2s"},
    {"duplicate": "/a", "message": 5, "by": "1ms"},
]


@pytest.fixture(scope="module")
def robot(searched: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    home = folder / "robot"
    (home / "more").mkdir(parents=True)
    shutil.copy(searched / "nodes_under_search.py", home / "more")
    (home / "more" / "last.yaml").write_text("/last: {ros__parameters: {unused: 1}}\n")
    (home / "job.yaml").write_text(ORDER_JOB)
    (home / "at_the_end.py").write_text(AT_THE_END)
    (home / "end.yaml").write_text(END_JOB)
    return home


def small(
    robot: Path, overlay: dict[str, Any], job: str = "job.yaml"
) -> tuple[TrialResult, ReducedTrial]:
    source = JobSource(str(robot / job))
    scratch = robot.parent / "scratch"
    scratch.mkdir(exist_ok=True)
    with Worker(source) as worker:
        given = worker.run(
            Trial(7, overlay, "found"), scratch / "given.mcap", TrialOptions(keep=True)
        )
        assert given.failure is not None, overlay
        return given, TrialReduction(source, given, worker, scratch).reduce()


def failing_seed(robot: Path) -> dict[str, Any]:
    with Worker(JobSource(str(robot / "job.yaml"))) as worker:
        for seed in range(100):
            overlay = {"seed": seed, "policy": "permutation"}
            trace = robot.parent / "seed.mcap"
            if worker.run(Trial(seed, overlay), trace, TrialOptions()).failure is not None:
                return overlay
    raise AssertionError("no order fails")


@pytest.mark.long
def test_an_order_that_fails_is_reduced_to_the_departures_it_needs(robot: Path) -> None:
    given, reduced = small(robot, failing_seed(robot))
    assert reduced.result.failure is not None
    assert reduced.result.failure.key == "two is last"
    assert reduced.is_minimal
    assert len(reduced.parts.departures or ()) == 1
    assert reduced.parts.until_ns == 100_000_000
    assert reduced.result.events < given.events
    assert reduced.passing is not None
    assert reduced.passing.departures == ()
    assert " before " in reduced.chosen[0]


@pytest.mark.long
def test_a_run_is_not_made_so_short_that_it_fails_for_its_shortness(robot: Path) -> None:
    _, reduced = small(robot, {"faults": FAULTS}, "end.yaml")
    assert reduced.parts.faults == (FAULTS[1],)
    assert reduced.parts.until_ns is None or reduced.parts.until_ns >= 600_000_000
    assert reduced.passing is not None


@pytest.mark.long
def test_a_folder_reproduces_the_run_also_when_it_is_moved_with_its_sources(
    robot: Path, command: Callable[..., Any], tmp_path: Path
) -> None:
    _, reduced = small(robot, {"faults": FAULTS, "seed": 5})
    assert reduced.parts.faults == (FAULTS[1],)
    assert reduced.parts.without == (0,)
    folder = robot / "found" / "first"
    decides = write_small(JobSource(str(robot / "job.yaml")), reduced, folder)
    assert "subscription /b of /last: no loss in a, lost in b" in decides
    text = (folder / "README.md").read_text()
    assert "two is last" in text
    assert "rsltrace diff passing.mcap failing.mcap\n" in text
    assert "\n  a  passing.mcap" in (folder / "diff.txt").read_text()
    assert "- the fault {drop: /b, message: 3}\n" in text
    assert "- it needs no idle\n" in text
    assert "seed" not in text
    assert {path.name for path in folder.iterdir()} == {
        "README.md", "diff.txt", "failing.mcap", "job.yaml", "passing.mcap", "passing.yaml",
        "test_reproduces.py",
    }  # fmt: skip
    with Trace.open(folder / "failing.mcap") as one, Trace.open(folder / "passing.mcap") as other:
        assert one.digest == reduced.result.digest != other.digest
    assert "/two" in (folder / "diff.txt").read_text() or "/b" in (folder / "diff.txt").read_text()
    moved = tmp_path / "elsewhere"
    shutil.copytree(robot, moved)
    for home in (robot, moved):
        if home is moved:
            (robot / "more" / "nodes_under_search.py").rename(tmp_path / "gone.py")
        done = command(
            "record", home / "found/first/job.yaml", "--json", "-q", "-o", tmp_path / "again.mcap",
            "--force",
        )  # fmt: skip
        assert done.returncode == 1
        assert json.loads(done.stdout)["digest"] == reduced.result.digest
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_reproduces.py"],
        cwd=moved / "found" / "first",
        capture_output=True,
        text=True,
    )
    (tmp_path / "gone.py").rename(robot / "more" / "nodes_under_search.py")
    assert done.returncode == 0, done.stdout
    assert "1 passed" in done.stdout


@pytest.mark.long
def test_the_command_searches_faults_and_makes_what_it_finds_small(
    robot: Path, command: Callable[..., Any], tmp_path: Path
) -> None:
    folder = tmp_path / "found"
    words = ["explore", robot / "job.yaml", "--strategy", "faults", "--jobs", 1, "-o", folder]
    done = command(*words, "--budget", 30, "--stop-at-first", "--minimize")
    assert done.returncode == 1, done.stderr
    readme = Path(done.stdout.partition("minimized: two is last: ")[2].splitlines()[0])
    assert readme.is_file()
    assert "- the fault {" in readme.read_text()
    assert "faults: " in done.stdout
    repeated = command("record", readme.parent / "job.yaml", "-q", "-o", tmp_path / "again.mcap")
    assert repeated.returncode == 1


@pytest.mark.long
def test_the_command_tries_each_combination_of_settings(
    write_job: Callable[[str, str], Path], tmp_path: Path, command: Callable[..., Any]
) -> None:
    text = ORDER_JOB.replace("more/last.yaml", "").replace("search_path: [., more]\n", "")
    text = text.replace("parameter_files: []", "name: last").replace("0.65s", "0.15s")
    text += "vary: {method: grid, settings: {nodes.two.parameters.value: [1, 2, 3]}}\n"
    job = write_job("settings", text)
    done = command("explore", job, "--strategy", "vary", "--jobs", 1, "-o", tmp_path / "found")
    assert done.returncode == 1, done.stderr
    assert "4 runs, 3 different digests, 2 failed of 1 cause" in done.stdout
    assert "settings (grid): 3 of 3 combinations of nodes.two.parameters.value" in done.stdout
    assert "every run has been tried" in done.stdout


@pytest.mark.long
def test_a_job_that_fails_by_its_own_delays_passes_without_them(robot: Path) -> None:
    """Nothing can be left out of its trial, which changes nothing."""
    (robot / "late.yaml").write_text("base: job.yaml\ndelay: {topics: {/b: 0.2s}}\n")
    _, reduced = small(robot, {}, "late.yaml")
    assert reduced.passing is not None
    assert reduced.passing.overlay() == {"set": {"delay": None}}
    assert reduced.passing_words == "the job without delays"
