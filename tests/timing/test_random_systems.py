"""No run takes longer than its bound: random systems (many: ``python -m campaigns.timing``)."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from campaigns.timing.random_systems import draw, held

pytestmark = pytest.mark.ros


def check(seeds: range, folder: Path) -> None:
    bounded = 0
    for seed in seeds:
        plan = draw(seed)
        for path, bound in held(plan, folder):
            if bound.ns is not None:
                bounded += 1
                assert path.worst_ns <= bound.ns, (plan.description, path.key, bound)
    assert bounded > 5 * len(seeds)


@pytest.mark.long
def test_no_run_takes_longer_than_its_bound(tmp_path: Path) -> None:
    check(range(3), tmp_path)


@pytest.mark.long
def test_no_run_of_many_takes_longer_than_its_bound(tmp_path: Path) -> None:
    check(range(3, 40), tmp_path)
