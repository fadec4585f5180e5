"""Every bug of the suite is found in another order or with other draws, and no fix is accused."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from campaigns.explore.suite import Bug, all_bugs
from tests.forked_command import Forks

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

BUGS = all_bugs()
USUAL = {"late_tf", "nested_call"}
"""Those of the default set."""

Attempt = Callable[..., int]


@pytest.fixture
def attempt(forks: Forks, tmp_path: Path) -> Attempt:
    """Run a job in the order that a seed makes (None: the plain one); return the exit status."""

    def run(job: Path, seed: int | None, *overrides: str) -> int:
        words = ["record", str(job), "-o", str(tmp_path / "run.mcap"), "--force", "--quiet"]
        if seed is not None:
            words += ["--set", "policy=permutation", "--seed", str(seed)]
        words += [word for one in overrides for word in ("--set", one)]
        done = forks.run(words, tmp_path, dict(os.environ), 300)
        assert done.returncode in (0, 1, 3), done.stderr
        return done.returncode

    return run


def marked(bugs: list[Bug]) -> list[object]:
    return [
        pytest.param(bug, id=bug.name, marks=() if bug.name in USUAL else pytest.mark.long)
        for bug in bugs
    ]


@pytest.mark.parametrize("bug", marked([b for b in BUGS if b.search != "faults"]))
def test_a_bug_shows_in_another_order_but_not_in_the_plain_one_nor_when_fixed(
    bug: Bug, attempt: Attempt
) -> None:
    assert attempt(bug.job, None) == 0
    failing = next((seed for seed in range(400) if attempt(bug.job, seed)), None)
    assert failing is not None
    for seed in {failing, 400, 401}:
        assert attempt(bug.fixed, seed) == 0, f"seed {seed}"


@pytest.mark.long
@pytest.mark.parametrize("bug", [b for b in BUGS if b.search == "faults"], ids=lambda b: b.name)
def test_a_bug_that_takes_a_fault_shows_at_some_times_and_never_when_fixed(
    bug: Bug, attempt: Attempt
) -> None:
    assert attempt(bug.job, None) == 0
    failing = [at for at in (147, 341, 535, 729) if attempt(bug.job, None, _fault(bug, at))]
    assert failing
    for at in (*failing[:2], 244):
        assert attempt(bug.fixed, None, _fault(bug, at)) == 0, f"{at} ms"


def _fault(bug: Bug, at_ms: int) -> str:
    is_of_bag = bug.folder.parent.name == "bags"
    when: dict[str, object] = {"message": at_ms // 50} if is_of_bag else {"at": f"{at_ms}ms"}
    return f"faults={json.dumps([{**bug.fault, **when}])}"


def test_the_suite_is_what_it_says() -> None:
    assert len(BUGS) >= 30
    assert len({bug.name for bug in BUGS}) == len(BUGS)
    assert len({bug.kind for bug in BUGS}) == len(BUGS)
    for bug in BUGS:
        assert bug.search in ("order", "delay", "faults", "lines")
        assert bool(bug.fault) == (bug.search == "faults")
        assert bug.fixed.is_file()
        assert (bug.folder / f"{bug.name}.py").is_file()
