"""The committed sample pairs: their reports are what diff says, and they can be made again."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rsltrace.trace.reader import Trace

SAMPLES = Path(__file__).parent.parent.parent / "sample_traces"


def maker() -> Any:
    spec = importlib.util.spec_from_file_location("make_samples", SAMPLES / "make_samples.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_samples"] = module
    spec.loader.exec_module(module)
    return module


MAKE = maker()
pairs = pytest.mark.parametrize("pair", MAKE.PAIRS, ids=lambda pair: pair.folder)


def test_every_folder_is_a_pair_with_all_its_files() -> None:
    folders = {path.parent.name for path in SAMPLES.glob("*/job.yaml")}
    assert folders == {pair.folder for pair in MAKE.PAIRS}
    for folder in folders:
        names = {path.name for path in (SAMPLES / folder).iterdir()}
        assert {"README.md", "a.mcap", "b.mcap", "job.yaml", "report.txt"} <= names
        for trace in (SAMPLES / folder).glob("*.mcap"):
            assert trace.stat().st_size < 100_000, trace


@pairs
def test_the_report_is_what_diff_prints(pair: Any) -> None:
    folder = SAMPLES / pair.folder
    assert MAKE.report(folder) == (folder / "report.txt").read_text(encoding="utf-8")


@pairs
def test_the_verdict_is_the_one_promised(pair: Any) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", "diff", "a.mcap", "b.mcap", "--format", "json"],
        cwd=SAMPLES / pair.folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert json.loads(done.stdout)["verdict"] == pair.verdict
    readme = (SAMPLES / "README.md").read_text(encoding="utf-8")
    assert f"[{pair.folder}]({pair.folder})" in readme
    assert f"`{pair.verdict}`" in readme


@pytest.mark.few(1)
@pytest.mark.ros
@pairs
def test_recording_them_again_gives_the_same_runs(pair: Any, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    if "PYTHONHASHSEED" in pair.a.environment and sys.version_info < (3, 11):
        pytest.skip("Python 3.10 hashes strings in another way")
    folder = SAMPLES / pair.folder
    for name, run in (("a", pair.a), ("b", pair.b)):
        output = tmp_path / f"{name}.mcap"
        MAKE.record(folder, run, output)
        with Trace.open(output) as made, Trace.open(folder / f"{name}.mcap") as kept:
            assert made.digest == kept.digest
            assert made.event_count == kept.event_count


@pytest.mark.parametrize(
    ("document", "before"),
    [
        ("README.md", "$ rsltrace diff a.mcap b.mcap\n"),
        ("docs/diff.md", "<!-- sample: nondeterministic_callback -->\n```text\n"),
    ],
)
def test_documents_show_lines_of_the_report_in_order(document: str, before: str) -> None:
    text = (SAMPLES.parent / document).read_text(encoding="utf-8")
    shown = text.partition(before)[2].partition("```")[0]
    folder = SAMPLES / "nondeterministic_callback"
    report = iter((folder / "report.txt").read_text(encoding="utf-8").splitlines())
    lines = [line for line in shown.splitlines() if line != "..."]
    assert len(lines) > 10
    for line in lines:
        assert line in report, f"{line!r} is not in the report, or not in this order"
