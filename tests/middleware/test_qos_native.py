"""QoS here and over the real DDS: the same nodes, the same pairs, the same events and messages.

Natively the nodes are two processes on real time, so a machine that is very busy may be late for a
deadline; a pair that differs is tried again, more and more slowly.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

pytestmark = [pytest.mark.ros, pytest.mark.native]

SCRIPT = Path(__file__).with_name("qos_matrix.py")
COUNT = 120
TRIES = 8


def matrix() -> Any:
    spec = importlib.util.spec_from_file_location("qos_matrix", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def natively(seed: int, folder: Path, slower: int) -> list[list[dict[str, Any]]]:
    """Run both nodes over DDS and return what the ends went through."""
    environment = {**os.environ, "ROS_LOG_DIR": str(folder)}
    start = str(time.time() + 2.0 * slower)  # both must be there in time
    runs = [
        subprocess.Popen(
            [sys.executable, str(SCRIPT), name, str(seed), str(COUNT), start, str(slower)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in ("offers", "asks")
    ]
    ends = []
    for run in runs:
        out, error = run.communicate(timeout=600)
        lines = [line for line in out.splitlines() if line.startswith("[{")]
        if not lines:
            pytest.skip(f"rclpy does not run natively here: {error.strip()[-300:]}")
        ends.append(json.loads(lines[-1]))
    return ends


def simulated(seed: int, simulate: Callable[..., Any]) -> list[list[dict[str, Any]]]:
    module = matrix()
    nodes: list[Any] = []

    def make(cls: Any) -> Callable[[], Any]:
        def node() -> Any:
            nodes.append(cls(seed, COUNT))
            return nodes[-1]

        return node

    simulate(make(module.Offers), make(module.Asks), duration=3.0)
    return [node.outcomes for node in nodes]


@pytest.mark.usefixtures("own_domain")
def test_every_pair_goes_through_the_same_here_and_over_dds(
    simulate: Callable[..., Any], tmp_path: Path
) -> None:
    seed = 1
    ours = simulated(seed, simulate)
    pairs = matrix().pairs(seed, COUNT)
    differing = set(range(COUNT))
    for number in range(TRIES):
        theirs = natively(seed, tmp_path, number + 1)
        differing &= {
            i for i in range(COUNT) if any(a[i] != b[i] for a, b in zip(ours, theirs, strict=True))
        }
        if not differing:
            break
    report = [
        f"{i}: offered {pairs[i][0]}, requested {pairs[i][1]}\n"
        f"  here {ours[0][i]} {ours[1][i]}\n  DDS  {theirs[0][i]} {theirs[1][i]}"
        for i in sorted(differing)
    ]
    assert not report, "\n".join(report)


def test_the_comparison_sees_something(simulate: Callable[..., Any]) -> None:
    """Every kind of outcome is among the pairs, or the comparison above would say little."""
    offers, asks = simulated(1, simulate)
    assert {end["incompatible"] for end in asks} == {0, 2, 4, 8, 16}
    assert {bool(end["deadlines"]) for end in offers} == {True, False}
    assert {bool(end["deadlines"]) for end in asks} == {True, False}
    assert {end["lost"] for end in offers} == {0, 1}
    assert {str(end["liveliness"]) for end in asks} == {"[]", "[[1, 0]]", "[[1, 0], [0, 1]]"}
    assert {str(end["late"]) for end in asks} == {"[]", "[4, 5]", "[1, 2, 3, 4, 5]"}
