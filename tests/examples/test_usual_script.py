"""The arithmetic and the table of ``benchmarks/usual.py``, its bare loop, and one case of it."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def usual(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("rclpy")
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for name in ("bare", "graphs", "throughput", "usual", "usual_graphs", "usual_nodes"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("usual")


def test_the_best_counts_and_is_held_against_its_aim(usual: ModuleType) -> None:
    nodes = usual.Case("nodes", "two nodes", "callback", {})
    mains = usual.Case("mains", "two mains", "callback", {}, 1.5, "nodes")
    logs = usual.Case("logs", "logs", "record", {}, 60)
    nodes.found = {"recorded": [9.0, 8.0], "native": [20.0, 24.0]}
    mains.found = {"recorded": [12.0, 16.0]}
    logs.found = {"recorded": [61.0]}
    table = usual.rows([nodes, mains, logs])
    assert table[0][2:] == ["", "20.0 µs", "", "8.0 µs", "2.5", "", "", "`nodes`"]
    assert table[1][5:9] == ["12.0 µs", "", "1.5 x nodes", "1.50, reached"]
    assert table[2][5:9] == ["61.0 µs", "", "60.0 µs", "missed"]


def test_large_figures_and_bytes_have_their_units(usual: ModuleType) -> None:
    files = usual.Case("files", "", "", {}, 35)
    assert usual.shown_figure(files, 34.56) == "34.6 B"
    assert usual.shown_figure(usual.Case("view", "", "", {}), 500_000) == "500.0 ms"


@pytest.mark.ros
@pytest.mark.long
def test_a_case_is_measured_in_processes_of_its_own() -> None:
    command = [sys.executable, str(BENCHMARKS / "usual.py"), "--scale", "0.01", "--repeat", "1"]
    command += ["--only", "files", "--only", "nodes", "--way", "bare", "--way", "recorded"]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr
    nodes, files = json.loads(done.stdout)
    assert nodes["case"] == "nodes"
    assert nodes["bare"] > 0
    assert nodes["recorded"] > 0
    # More than an event's own hash and numbers, less than all that it is before compression.
    assert 16 < files["recorded"] < 200
