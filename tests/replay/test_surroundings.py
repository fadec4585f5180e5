"""A trace replays wherever one is: in surroundings unlike those in which it was made.

They are those of ``rsltrace verify``: hash seed, addresses, folder, locale, time zone, heap, load,
threads. The traces in sample_traces were made by some Python; these tests run in all that CI has.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.search import perturb
from rsltrace.search.perturb import perturbation
from rsltrace.trace.reader import Trace
from sample_traces.make_samples import PAIRS
from tests.replay.test_jobs_replay import EXAMPLES, ROOT

pytestmark = pytest.mark.ros

RUNS = {
    f"{pair.folder}/{side}.mcap": run.environment
    for pair in PAIRS
    for side, run in (("a", pair.a), ("b", pair.b))
}
"""The sample traces, and what from outside made them what they are."""

USUAL = "schedule/b.mcap"


def check(trace: Path, folder: Path, place: Path, numbers: range) -> None:
    """Replay a trace in processes with surroundings of these numbers."""
    with Trace.open(trace) as opened:
        expected = opened.event_count, opened.digest, True
    words = ["replay", str(trace), "--job-folder", str(folder), "--trust", "--quiet", "--json"]
    for number in numbers:
        around = perturbation(number)
        if "PYTHONHASHSEED" in os.environ:
            values = {**around.values, perturb.HASH_SEED: os.environ["PYTHONHASHSEED"]}
            around = replace(around, values=values)
            words.append("--no-pin")
        done = perturb.run_in(around, words, place)
        assert done.exit_code == 0, f"{around}\n{done.output}\n{done.errors}"
        found: dict[str, Any] = json.loads(done.output)
        assert (found["verified"], found["digest"], found["is_whole"]) == expected, str(around)


@pytest.mark.parametrize(
    "name", [name if name == USUAL else pytest.param(name, marks=pytest.mark.long) for name in RUNS]
)
def test_sample_traces(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they are in the repository, whoever has made them."""
    monkeypatch.delenv("PYTHONHASHSEED", raising=False)
    for variable, value in RUNS[name].items():
        monkeypatch.setenv(variable, value)
    path = ROOT / "sample_traces" / name
    check(path, path.parent, tmp_path, range(1, 2))


@pytest.mark.long
@pytest.mark.parametrize(("job", "overrides"), EXAMPLES)
def test_examples(
    job: str, overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``RSLTRACE_OTHER_PYTHON`` is the program of another Python that has rsltrace, too, if any."""
    monkeypatch.delenv("PYTHONHASHSEED", raising=False)
    path = tmp_path / "run.mcap"
    done = run(load_job(ROOT / job, overrides=overrides), path)
    assert done.error is None
    check(path, (ROOT / job).parent, tmp_path, range(1, 3))
    if "RSLTRACE_OTHER_PYTHON" in os.environ:
        monkeypatch.setattr("sys.executable", os.environ["RSLTRACE_OTHER_PYTHON"])
        check(path, (ROOT / job).parent, tmp_path, range(1))
