"""Which keys of a job a native run follows, and which it says are without effect."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from rsltrace.job import Job, load_job
from rsltrace.native.support import Patience, ignored

FOLLOWED = {
    *("nodes", "bags", "launch", "ros_arguments", "search_path", "stop"),
    *("progress", "record", "checks", "metrics"),
    *("source_name", "given_text", "base_dir", "composed"),
}
REFUSED = {"hooks"}


def test_every_key_of_a_job_is_followed_refused_or_named_as_without_effect() -> None:
    everything = set(Job.fields)
    job = Job(nodes=[{"node": "m:N"}])
    given = {name: getattr(job, name) for name in everything}
    named = ignored(job.with_values(**{**given, "nodes": ()}))
    keys = {name for name in everything if name.removesuffix("_ns") in named}
    assert everything - keys == FOLLOWED | REFUSED


def test_a_machine_that_stands_still_takes_no_time_from_those_who_are_waited_for() -> None:
    waits: list[float] = []  # each of which may have lasted for minutes
    patience = Patience(1.0)
    assert patience.wait(waits.append, lambda: len(waits) == 15)
    assert not patience.wait(waits.append, lambda: False)
    assert sum(waits) == pytest.approx(1.0)


ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*/job*.yaml"))
HUSKY = ROOT.parent / "shared" / "data" / "husky_outdoor"


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_jobs_are_the_same_in_another_process(path: Path) -> None:
    if "husky" in path.name and not HUSKY.exists():
        pytest.skip("the Husky recording is not here")
    job = load_job(path)
    other = pickle.loads(pickle.dumps(job))
    assert other.resolved() == job.resolved()
