"""Runs that are forked from a common prefix are those from the beginning, byte for byte."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from campaigns.explore.suite import all_bugs
from rsltrace.errors import ExploreError
from rsltrace.job import job_from_text
from rsltrace.search.explore.outcome import TrialOptions
from rsltrace.search.explore.strategies.faults import FaultWalk
from rsltrace.search.explore.strategies.named import strategy_named
from rsltrace.search.explore.strategies.strategy import choices_left
from rsltrace.search.explore.trial import JobSource, Trial, TrialResult
from rsltrace.search.explore.workers import Worker

ALIKE_NS = 450_000_000
JOB = """\
nodes:
  - {node: nodes_under_search:Sender, name: one, parameters: {value: 1, topic: a}}
  - {node: nodes_under_search:Sender, name: two, parameters: {value: 2, topic: b}}
  - {node: nodes_under_search:Last}
stop: {duration: 0.75s}
record: {segment_events: 7}
"""
CHECKED = f"{JOB}checks: [{{name: the second comes last, never: '/last: data == 1'}}]\n"
OVERLAYS: list[tuple[dict[str, Any], str]] = [
    ({"policy": {"pct": {"depth": 2, "choices": 8}, "after": "0.45s", "seed": 3}}, ""),
    ({"policy": {"departures": [{"choice": 2, "run": 1}]}}, "its order departs from"),
    ({"faults": [{"drop": "/a", "message": 6}, {"restart": "/two", "event": 35}]}, ""),
    ({"faults": [{"drop": "/a", "message": 2}]}, "it has a fault up to 0.400000000 s"),
]


@pytest.fixture(scope="module")
def alike(write_job: Callable[[str, str], Path]) -> Iterator[Worker]:
    """A worker that has loaded what a run needs: its first run is never forked."""
    source = JobSource(str(write_job("alike", JOB)))
    with Worker(source) as one:
        one.run(Trial(0, {}), Path(source.path).with_suffix(".mcap"), TrialOptions(), 300)
        yield one


def _both(
    worker: Worker, number: int, overlay: dict[str, Any], wants: TrialOptions, folder: Path
) -> TrialResult:
    """Run a trial forked and from the beginning; both have to be equal. Return the first."""
    forked, whole = (folder / f"{name}{number}.mcap" for name in ("forked", "whole"))
    found = worker.run(Trial(number, overlay), forked, wants, 300)
    other = worker.run(Trial(number, overlay), whole, replace(wants, fork_ns=-1), 300)
    assert not other.is_forked
    assert forked.read_bytes() == whole.read_bytes()
    apart = {"wall_s": 0, "trace": "", "choices_before": 0, "why_not_forked": ""}
    assert replace(found, is_forked=False, **apart) == replace(other, **apart)
    return found


@pytest.mark.long
def test_a_forked_run_is_the_one_from_the_beginning(alike: Worker, tmp_path: Path) -> None:
    wants = TrialOptions(keep=True, behaviours=True, steps=True, fork_ns=ALIKE_NS)
    digests = set()
    for number, (overlay, why) in enumerate(OVERLAYS):
        found = _both(alike, number, overlay, wants, tmp_path)
        assert found.is_forked == (not why), found.why_not_forked
        assert why in found.why_not_forked
        digests.add(found.digest)
    assert len(digests) == len(OVERLAYS)
    assert not list(tmp_path.glob("*.unfinished*"))


def test_strategies_leave_the_beginning_as_it_is(alike: Worker, tmp_path: Path) -> None:
    job = job_from_text(JOB, "alike.yaml", ".")
    plain = alike.run(
        Trial(0, {"policy": {"departures": []}}),
        tmp_path / "plain.mcap",
        TrialOptions(keep=True, behaviours=True, steps=True, fork_ns=ALIKE_NS),
        300,
    )
    assert 0 < plain.choices_before < plain.choices
    for name in ("pct", "random", "feedback", "mixed", "systematic", "faults"):
        strategy = strategy_named(name, job, fork_after=("0.45s", ALIKE_NS))
        strategy.begin(plain)
        for number in range(1, 12):
            proposal = strategy.propose(number)
            if proposal is None:
                break
            (key,) = proposal.overlay
            policy = proposal.overlay.get("policy", {})
            assert key == "faults" or "after" in policy or "departures" in policy
            for one in policy.get("departures", ()):
                assert one["choice"] >= plain.choices_before
            for fault in proposal.overlay.get("faults", ()):
                assert fault.get("event", 99) > 20
                assert fault.get("message", 99) > 4
        assert number > 3
    with pytest.raises(ExploreError, match="no choice of what runs next after that time"):
        choices_left(replace(plain, choices_before=plain.choices))
    with pytest.raises(ExploreError, match="ends before the time of --fork-after"):
        FaultWalk(job, fork_ns=10**9).begin(plain)
    with pytest.raises(ExploreError, match="runs with other settings differ"):
        strategy_named("vary", job, fork_after=("1s", 10**9))
    ordered = job_from_text(f"{JOB}policy: permutation\n", "alike.yaml", ".")
    with pytest.raises(ExploreError, match=r"alike.yaml:7:\d+: up to that time the order"):
        strategy_named("pct", ordered, fork_after=("1s", 10**9))


@pytest.mark.long
def test_a_search_forks_and_what_it_finds_is_repeated_from_the_beginning(
    write_job: Callable[[str, str], Path], tmp_path: Path, command: Callable[..., Any]
) -> None:
    job = write_job("forked", CHECKED)
    words = ["--budget", 25, "--jobs", 1, "--fork-after", "0.45s"]
    done = command("explore", job, *words, "-o", tmp_path / "found")
    assert done.returncode == 1, done.stderr
    assert re.search(r"^24 runs forked from the default run$", done.stdout, re.MULTILINE)
    assert "made from the beginning" not in done.stdout
    again = shlex.split(re.search(r"reproduce: rsltrace (.*)", done.stdout)[1])
    repeated = command(*again, "-q", "-o", tmp_path / "again.mcap")
    assert repeated.returncode == 1
    refused = command("explore", job, "--resume", "--fork-after", "0.5s", "-o", tmp_path / "found")
    assert "has a different search (fork after differs)" in refused.stderr


BEYOND = {
    "a thread of a library": (
        "import ctypes, threading\n"
        "libc = ctypes.CDLL(None)\n"
        "begin = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)\n"
        "where = ctypes.c_ulong()\n"
        "libc.pthread_create(ctypes.byref(where), None, libc.pause, None)\n",
        "1 real thread of a library run in it",
    ),
    "a file that is read and written": (
        "kept = open('/dev/shm/rsltrace-test-prefix', 'w+')\n",
        "open for reading and writing",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("what", BEYOND)
def test_what_cannot_be_copied_is_run_from_the_beginning(
    write_job: Callable[[str, str], Path], tmp_path: Path, what: str
) -> None:
    code, why = BEYOND[what]
    module = "beyond_" + what.replace(" ", "_")
    (tmp_path / f"{module}.py").write_text(
        "from nodes_under_search import Last as Other\n\n\nclass Last(Other):\n"
        "    def __init__(self):\n        super().__init__()\n"
        + "".join(f"        {line}\n" for line in code.splitlines())
        + "        self.kept = dict(locals())\n"
    )
    job = write_job("beyond", JOB.replace("nodes_under_search:Last", f"{module}:Last"))
    job.write_text(f"{job.read_text()}search_path: ['.', {tmp_path}]\nguard: false\n")
    wants = TrialOptions(keep=True, fork_ns=ALIKE_NS)
    overlay = {"policy": {"departures": [{"choice": 19, "run": 1}]}}
    with Worker(JobSource(str(job))) as worker:
        worker.run(Trial(0, {}), tmp_path / "plain.mcap", wants, 300)
        found = [worker.run(Trial(n, overlay), tmp_path / f"{n}.mcap", wants, 300) for n in (1, 2)]
    Path("/dev/shm/rsltrace-test-prefix").unlink(missing_ok=True)
    assert found[0].failure is None
    assert found[0].digest == found[1].digest
    assert not found[0].is_forked
    assert why in found[0].why_not_forked


@pytest.mark.long
@pytest.mark.parametrize("bug", all_bugs()[::20], ids=lambda bug: bug.name)
def test_the_suite_of_bugs_forks_in_the_middle(bug: Any, tmp_path: Path) -> None:
    source = JobSource(str(bug.job))
    wants = TrialOptions(keep=True, behaviours=True, steps=True)
    with Worker(source) as worker:
        plain = worker.run(
            Trial(0, {"policy": {"departures": []}}), tmp_path / "p.mcap", wants, 300
        )
        half_ns = plain.end_ns // 2
        wants = replace(wants, fork_ns=half_ns)
        after = {"after": f"{half_ns}ns", "seed": 5}
        walk = FaultWalk(source.job(), 7, fork_ns=half_ns)
        walk.begin(plain)
        overlays: list[Any] = [
            {"policy": {"pct": {"depth": 3, "choices": 9}, **after}},
            {"policy": {"order": "permutation", **after}},
            *(walk.propose(number).overlay for number in (1, 2)),
        ]
        for number, overlay in enumerate(overlays, 1):
            assert _both(worker, number, overlay, wants, tmp_path).is_forked
