"""The benchmark's own arithmetic, and how it behaves where something cannot be measured."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def throughput(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    for name in ("graphs", "throughput"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("throughput")


def workers(monkeypatch: pytest.MonkeyPatch, module: ModuleType, *answers: dict[str, Any]) -> list:
    """Answer for the worker processes, in turn; return the amounts they were asked for."""
    left, asked = list(answers), []

    def run_worker(_: Any, amount: float) -> dict[str, Any]:
        asked.append(amount)
        return left.pop(0)

    monkeypatch.setattr(module, "run_worker", run_worker)
    return asked


def test_start_up_counts_for_neither_side(
    throughput: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # 10 µs a callback (8 of CPU), and nearly each time somebody else in the way.
    busy_s = iter((0.2, 0.0, 0.7))
    lengths = []

    def run(_: Any, events: int, folder: Path, **how: bool) -> dict[str, Any]:
        assert how == {"record": True, "delayed": True}
        lengths.append(events)
        more_s = next(busy_s)
        times = {"wall_s": 10e-6 * events + more_s, "cpu_s": 8e-6 * events + more_s}
        return {"callbacks": events, "start_up_s": 0.3 + more_s, **times}

    monkeypatch.setattr(throughput, "run_rsltrace", run)
    figures = throughput.work("graph8/rsltrace_recorded_delayed", 100_000, tmp_path)
    assert lengths == [100_000] * 3
    workers(monkeypatch, throughput, figures)
    case = throughput.Case("graph8", "rsltrace_recorded_delayed")
    throughput.measure(case, 100_000)
    assert case.us == [pytest.approx(10.0)]
    assert case.cpu_us == [pytest.approx(8.0)]
    assert case.start_up_s == [pytest.approx(0.5)]  # that of the first run, whatever was in the way


def test_a_native_case_is_wall_time_over_callbacks(
    throughput: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = workers(monkeypatch, throughput, {"callbacks": 20_000, "wall_s": 3.0, "cpu_s": 4.0})
    case = throughput.Case("graph8", "single_threaded")
    throughput.measure(case, 3.0)
    assert asked == [3.0]
    assert case.us == [pytest.approx(150.0)]
    assert case.cpu_us == [pytest.approx(200.0)]


def test_what_went_wrong_is_kept_and_no_figure_made_up(
    throughput: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    workers(monkeypatch, throughput, {"problem": "not available: no rclpy"})
    case = throughput.Case("graph8", "rsltrace")
    throughput.measure(case, 100_000)
    assert case.us == []
    throughput.print_table([case])
    assert "not available: no rclpy" in capsys.readouterr().out


def test_ratios_compare_the_best_with_the_aims(throughput: ModuleType) -> None:
    def case(graph: str, mode: str, *us: float) -> Any:
        return throughput.Case(graph, mode, us=list(us), cpu_us=[2 * each for each in us])

    found = throughput.ratios(
        [
            case("graph8", "single_threaded", 160.0, 170.0, 900.0),
            case("graph8", "events_executor", 12.0),
            case("graph8", "rsltrace_recorded", 12.0, 10.0, 11.0),
            case("graph200", "rsltrace_recorded", 11.0),
        ]
    )
    assert [each["cpu_x"] for each in found] == [each["x"] for each in found]
    assert [(each["slow"], each["x"], each.get("aim")) for each in found] == [
        ("single_threaded", pytest.approx(16.0), 15.0),
        ("events_executor", pytest.approx(1.2), 1.2),
        ("rsltrace_recorded", pytest.approx(1.1), None),
    ]


def test_a_worker_that_dies_is_reported_by_its_last_words(
    throughput: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.py"
    broken.write_text("raise SystemExit('the network is on fire')")
    monkeypatch.setattr(throughput, "__file__", str(broken))
    figures = throughput.run_worker(throughput.Case("graph8", "rsltrace"), 1)
    assert figures == {"problem": "exit status 1: the network is on fire"}


def test_the_command_lists_and_filters_its_cases() -> None:
    command = [sys.executable, str(BENCHMARKS / "throughput.py"), "--list", "--only", "graph200"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    modes = ("", "_delayed", "_recorded", "_recorded_delayed", "_recorded_python")
    assert done.stdout.split() == [f"graph200/rsltrace{mode}" for mode in modes]
    nothing = subprocess.run(
        [*command[:-1], "no such case"], capture_output=True, text=True, check=False
    )
    assert nothing.returncode == 2


@pytest.mark.long
@pytest.mark.ros
def test_both_rsltrace_cases_do_the_same_work(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    figures = {}
    for mode in ("rsltrace", "rsltrace_recorded"):
        command = [str(BENCHMARKS / "throughput.py"), "--worker", f"graph8/{mode}", "2000"]
        done = subprocess.run(
            [sys.executable, *command, str(tmp_path)], capture_output=True, text=True, check=True
        )
        figures[mode] = json.loads(done.stdout.splitlines()[-1])
    assert figures["rsltrace"]["callbacks"] == figures["rsltrace_recorded"]["callbacks"] > 1800
    assert figures["rsltrace"]["bytes"] == 0
    assert figures["rsltrace_recorded"]["bytes"] > 10_000
    assert len(figures["rsltrace_recorded"]["digest"]) == 16
