"""What a team's tests get: running jobs, golden traces, the pytest plugin."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from rsltrace.errors import OutputError, TraceError
from rsltrace.testing import GoldenMismatch, assert_matches_golden
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.reader import Trace

SAMPLE = Path(__file__).parent.parent.parent / "sample_traces" / "nondeterministic_callback"
A, B = SAMPLE / "a.mcap", SAMPLE / "b.mcap"

NODES = """
import os
from rclpy.node import Node
from std_msgs.msg import UInt64

class Counter(Node):
    def __init__(self):
        super().__init__('counter')
        self.publisher = self.create_publisher(UInt64, 'count', 10)
        self.count = 0
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.count += 1
        step = int(os.environ.get('STEP', '1')) if self.count > 5 else 1
        self.publisher.publish(UInt64(data=self.count * step))
"""
JOB = """
nodes:
  - node: counting:Counter
stop: {duration: 1s}
"""


def test_a_trace_matches_itself() -> None:
    assert not assert_matches_golden(A, A)
    assert not assert_matches_golden(str(A), str(A))


def test_the_report_is_the_message(tmp_path: Path) -> None:
    golden = tmp_path / "golden.mcap"
    shutil.copy(A, golden)
    with pytest.raises(GoldenMismatch) as caught:
        assert_matches_golden(B, golden)
    text = str(caught.value)
    assert text.startswith("/obstacle_filter: the callback for /scan at 2.1 s received the same")
    assert "-0.19956212899502734" in text
    assert text.endswith("pytest --rsltrace-update accepts what it does now")
    assert isinstance(caught.value, AssertionError)


def test_a_cut_trace_matches_nothing_and_becomes_no_golden_one(tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(A.read_bytes()[:-300])
    for run, golden in ((cut, A), (A, cut), (cut, cut)):
        with pytest.raises(GoldenMismatch, match="agree in the first"):
            assert_matches_golden(run, golden)
    golden = tmp_path / "golden.mcap"
    with pytest.raises(TraceError, match="is cut: its run was killed"):
        assert_matches_golden(cut, golden, update=True)
    assert not golden.exists()


def test_update_writes_only_what_is_another_run(tmp_path: Path) -> None:
    golden = tmp_path / "new" / "golden.mcap"
    with pytest.raises(TraceError, match="there is no golden trace"):
        assert_matches_golden(A, golden)
    assert assert_matches_golden(A, golden, update=True)
    assert golden.read_bytes() == A.read_bytes()
    before = golden.stat().st_mtime_ns
    assert not assert_matches_golden(A, golden, update=True)
    assert golden.stat().st_mtime_ns == before
    assert assert_matches_golden(B, golden, update=True)
    golden.write_bytes(b"rubbish")
    assert assert_matches_golden(A, golden, update=True)
    assert [path.name for path in golden.parent.iterdir()] == ["golden.mcap"]


@pytest.mark.parametrize("there", [False, True])
def test_an_update_takes_the_place_of_a_link(tmp_path: Path, there: bool) -> None:
    """What it points to may be the golden trace of another test, too."""
    shared = tmp_path / "shared.mcap"
    if there:
        shared.write_bytes(A.read_bytes())
    (tmp_path / "golden.mcap").symlink_to(shared)
    assert assert_matches_golden(B, tmp_path / "golden.mcap", update=True)
    assert not (tmp_path / "golden.mcap").is_symlink()
    assert (tmp_path / "golden.mcap").read_bytes() == B.read_bytes()
    assert shared.exists() == there
    assert not there or shared.read_bytes() == A.read_bytes()


def test_a_golden_trace_that_cannot_be_written_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    golden = tmp_path / "golden.mcap"
    makers: list[Callable[[Path], object]] = [Path.mkdir]
    if hasattr(os, "mkfifo"):  # a device or a pipe would be replaced
        makers.append(os.mkfifo)
    for make in makers:
        make(golden)
        kind = golden.stat().st_mode
        with pytest.raises(
            OutputError, match=r"golden trace .*golden\.mcap cannot be written: it is a"
        ):
            assert_matches_golden(A, golden, update=True)
        assert list(tmp_path.iterdir()) == [golden]
        assert golden.stat().st_mode == kind
        golden.rmdir() if golden.is_dir() else golden.unlink()


def test_a_run_that_was_not_recorded_cannot_be_compared() -> None:
    pytest.importorskip("rclpy")
    from rsltrace.run import RunResult

    result = RunResult(None, "0" * 16, 0, 0, 0, "", 0)
    with pytest.raises(TraceError, match="was not recorded"):
        assert_matches_golden(result, A)


@pytest.mark.long
def test_loading_the_plugin_loads_nothing_heavy() -> None:
    heavy = ("rclpy", "numpy", "pydantic", "ruamel", "rosbags", "mcap", "rich", "click")
    probe = (
        "import rsltrace.testing.plugin, rsltrace.testing, sys\n"
        f"print(*[m for m in {heavy!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def team(tmp_path: Path) -> Run:
    """A team's repository with a robot and a test, and a way to run its pytest.

    Our plugin is the only one: all those of this environment take a second to load.
    """
    (tmp_path / "counting.py").write_text(NODES)
    (tmp_path / "job.yaml").write_text(JOB)
    ours = ["-p", "rsltrace.testing.plugin", "-p", "no:cacheprovider"]
    alone = {"PYTEST_ADDOPTS": "", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}

    def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "pytest", *ours, *arguments],
            cwd=tmp_path,
            env={**os.environ, **environment, **alone},
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )

    return run


def test_pytest_finds_the_plugin_by_itself() -> None:
    found = [entry for entry in entry_points(group="pytest11") if entry.name == "rsltrace"]
    assert {entry.value for entry in found} == {"rsltrace.testing.plugin"}


@pytest.mark.long
@pytest.mark.ros
def test_the_fixture_makes_compares_and_updates_golden_traces(team: Run, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    (tmp_path / "test_robot.py").write_text(
        "def test_counts(rsltrace_golden):\n"
        "    result = rsltrace_golden('job.yaml')\n"
        "    assert result.events > 10\n"
    )
    golden = tmp_path / "golden" / "test_counts.mcap"

    missing = team()
    assert missing.returncode == 1
    assert "there is no golden trace" in missing.stdout
    assert "--rsltrace-update" in missing.stdout
    assert "During handling of the above exception" not in missing.stdout
    assert not golden.exists()

    made = team("--rsltrace-update")
    assert made.returncode == 0, made.stdout
    assert "golden traces written by --rsltrace-update" in made.stdout
    assert made.stdout.count(str(golden)) == 1

    same = team("-W", "error")  # other packages' use of old modules does not concern the user
    assert same.returncode == 0, same.stdout
    again = team("--rsltrace-update")
    assert again.returncode == 0
    assert "golden traces written" not in again.stdout

    changed = team(STEP="2")
    assert changed.returncode == 1
    assert "same-input-different-output" in changed.stdout
    assert "6  |  12" in changed.stdout
    assert "in _report" not in changed.stdout

    assert team("--rsltrace-update", STEP="2").returncode == 0
    assert team(STEP="2").returncode == 0
    assert team().returncode == 1


@pytest.mark.long
@pytest.mark.ros
def test_a_job_that_cannot_be_used_is_one_line(team: Run, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    (tmp_path / "job.yaml").write_text("nodes: [{nod: counting:Counter}]\n")
    (tmp_path / "test_robot.py").write_text(
        "def test_counts(rsltrace_golden):\n    rsltrace_golden('job.yaml')\n"
    )
    done = team()
    assert done.returncode == 1
    assert "job.yaml:1:10: unknown key 'nod'" in done.stdout
    assert "Error" not in done.stdout, "a traceback of rsltrace's own code"


@pytest.mark.long
@pytest.mark.ros
def test_jobs_and_results_in_one_test(team: Run, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    (tmp_path / "test_more.py").write_text(
        "from rsltrace.testing import run_job\n"
        "def test_all(rsltrace_golden, tmp_path):\n"
        "    result = run_job('job.yaml', tmp_path, name='mine.mcap')\n"
        "    assert result.path.name == 'mine.mcap'\n"
        "    assert rsltrace_golden(result, 'g/one.mcap') is None\n"
        "    again = rsltrace_golden('job.yaml', 'g/one.mcap')\n"
        "    assert again.digest == result.digest\n"
        "    rsltrace_golden(again)\n"
    )
    made = team("--rsltrace-update")
    assert made.returncode == 0, made.stdout
    assert sorted(path.name for path in (tmp_path / "g").iterdir()) == ["one.mcap"]
    assert (tmp_path / "golden" / "test_all_3.mcap").exists()
    assert team().returncode == 0


@pytest.mark.ros
def test_assert_matches_golden_runs_a_job(team: Run, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    (tmp_path / "test_job.py").write_text(
        "import pytest\n"
        "from rsltrace.errors import JobError\n"
        "from rsltrace.testing import assert_matches_golden\n"
        "def test_job():\n"
        "    assert assert_matches_golden('job.yaml', 'golden.mcap', update=True)\n"
        "    assert not assert_matches_golden('job.yaml', 'golden.mcap')\n"
        "    with pytest.raises(JobError):\n"
        "        assert_matches_golden('nothing.yaml', 'golden.mcap')\n"
    )
    done = team()
    assert done.returncode == 0, done.stdout


@pytest.mark.ros
@pytest.mark.long
def test_the_option_holds_without_the_fixture(team: Run, tmp_path: Path) -> None:
    """What the message says to do has to help whoever it is shown to."""
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    (tmp_path / "test_plain.py").write_text(
        "from rsltrace.testing import assert_matches_golden\n"
        "def test_job():\n"
        "    assert_matches_golden('job.yaml', 'golden.mcap')\n"
        "def test_other():\n"
        "    pass\n"
    )
    missing = team()
    assert missing.returncode == 1
    assert "golden.mcap: pytest --rsltrace-update writes it" in missing.stdout
    made = team("--rsltrace-update")
    assert made.returncode == 0, made.stdout
    assert made.stdout.count(str(tmp_path / "golden.mcap")) == 1
    assert team().returncode == 0
    assert team(STEP="2").returncode == 1


@pytest.mark.long
@pytest.mark.ros
def test_tests_are_no_code_of_the_job(team: Run, tmp_path: Path) -> None:
    """Another test beside it is no reason why a run is another one; a node in a test is."""
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    (tmp_path / "conftest.py").write_text("")
    (tmp_path / "test_robot.py").write_text(
        "def test_counts(rsltrace_golden):\n    rsltrace_golden('job.yaml')\n"
    )
    (tmp_path / "test_own.py").write_text(
        "import rsltrace\n"
        "from counting import Counter\n"
        "class Mine(Counter):\n"
        "    pass\n"
        "def test_own(rsltrace_golden):\n"
        "    node = rsltrace.NodeSpec(node=Mine)\n"
        "    stop = rsltrace.StopSpec(duration='1s')\n"
        "    rsltrace_golden(rsltrace.Job(nodes=[node], stop=stop, search_path=['.']))\n"
    )
    made = team("--rsltrace-update")
    assert made.returncode == 0, made.stdout
    assert _modules(tmp_path / "golden" / "test_counts.mcap") == {"counting"}
    assert _modules(tmp_path / "golden" / "test_own.mcap") == {"counting", "test_own"}


@pytest.mark.long
def test_comparisons_are_lines_of_a_history(team: Run, tmp_path: Path) -> None:
    (tmp_path / "test_robot.py").write_text(
        "from rsltrace.testing import assert_matches_golden\n"
        f"a, b = {str(A)!r}, {str(B)!r}\n"
        "def test_same(rsltrace_golden):\n    rsltrace_golden(a, 'a.mcap')\n"
        "def test_other():\n    assert_matches_golden(b, 'a.mcap')\n"
        "def test_missing(rsltrace_golden):\n    rsltrace_golden(b, 'b.mcap')\n"
    )
    shutil.copy(A, tmp_path / "a.mcap")
    team("--rsltrace-history", "option.jsonl")
    (tmp_path / "pytest.ini").write_text("[pytest]\nrsltrace_history = ini.jsonl\n")
    team("-k", "same")
    team("-k", "same", RSLTRACE_HISTORY="variable.jsonl")
    team("-k", "same", "--rsltrace-update")

    def verdicts(name: str) -> list[tuple[str, str]]:
        lines = (tmp_path / name).read_text().splitlines()
        return [(one["job"], one["verdict"]) for one in map(json.loads, lines)]

    same = ("a.mcap", "passed")
    assert verdicts("option.jsonl") == [same, ("a.mcap", "failed"), ("b.mcap", "error")]
    assert verdicts("ini.jsonl") == verdicts("variable.jsonl") == [same]
    failed = (tmp_path / "option.jsonl").read_text().splitlines()[1]
    assert "/obstacle_filter: the callback for /scan at 2.1 s" in failed


def _modules(path: Path) -> set[str]:
    with Trace.open(path) as trace:
        return set(trace.metadata(METADATA_SOURCES))
