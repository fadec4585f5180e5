"""A trace may come from anybody: what it names runs only where the user's own job file names it, or
where somebody has said so; and opening one never runs anything."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

import rsltrace
from rsltrace.cli.main import cli
from rsltrace.errors import ReplayError
from rsltrace.job import load_job
from rsltrace.replay.preparation import prepare_replay
from rsltrace.run import run
from rsltrace.run.provenance import write_job
from rsltrace.trace.writer import TraceWriter
from tests.replay.conftest import JOB

pytestmark = pytest.mark.ros


@pytest.fixture
def here(recorded: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A trace in the folder of its job, which is the present one."""
    monkeypatch.chdir(tmp_path)
    recorded()
    return Path("run.mcap")


def test_the_job_of_the_present_folder_runs_unasked(here: Path) -> None:
    assert rsltrace.replay(here).is_whole


@pytest.mark.long
@pytest.mark.parametrize("override", ["seed=5", "stop.duration=1s", "delay.default=1ms"])
def test_a_trace_of_it_with_another_seed_or_end(
    here: Path, recorded: Callable[..., Path], override: str
) -> None:
    recorded(overrides=[override])
    if override.startswith("delay"):
        with pytest.raises(ReplayError, match=r"its job differs from job\.yaml in delay"):
            rsltrace.replay(here)
    else:
        assert rsltrace.replay(here).is_whole


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("nodes.0.parameters.gain=7.0", "nodes"),
        (
            'nodes.+={"main": "timeit:main", "arguments": ["-s", "1/0"]}',
            "nodes",
        ),
        ("stop.function=timeit:main", "stop.function"),
        ("policy.function=nodes_of_replay:Source", "policy"),
        ("hooks.after=nodes_of_replay:Source", "hooks"),
        ('ros_arguments=["-p", "a:=1"]', "ros_arguments"),
        ("guard.clock=allow", "guard"),
        ('search_path=[".", ".."]', "search_path"),
        ('launch.+={"file": "evil.launch.xml", "arguments": {}}', "launch"),
    ],
)
def test_a_trace_that_names_other_code_or_other_input(
    here: Path, tmp_path: Path, override: str, key: str
) -> None:
    """Its text may be that of the job file here: what counts is the job that would run."""
    (tmp_path / "evil.launch.xml").write_text("<launch></launch>")
    write_hostile(tmp_path / "run.mcap", overrides=(override,))
    with pytest.raises(ReplayError, match=f"would run code, and its job differs .* in .*{key}"):
        rsltrace.replay(here)
    done = CliRunner().invoke(cli, ["replay", "run.mcap"])
    assert done.exit_code == 2
    assert "nothing was run; use --trust if" in done.stderr


def write_hostile(path: Path, overrides: tuple[str, ...]) -> None:
    """Write a trace whose job text is that of the job file, and whose job is another."""
    own = load_job(path.with_name("job.yaml"))
    other = load_job(path.with_name("job.yaml"), overrides=overrides)
    path.unlink()
    with TraceWriter(path, force=False) as writer:
        write_job(writer, other.replace(composed=None, source_text=own.source_text))
        writer.add_event(bytes(62), 1)
        writer.close(result={})


@pytest.mark.long
def test_code_elsewhere(here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A trace, a job file and nodes that agree with each other, in a folder of downloads."""
    marker = tmp_path / "ran"
    nodes = tmp_path / "nodes_of_replay.py"
    nodes.write_text(f"open({str(marker)!r}, 'w').close()\n{nodes.read_text()}")
    above = tmp_path / "above"
    above.mkdir()
    monkeypatch.chdir(above)
    with pytest.raises(ReplayError, match="which is not the working directory"):
        rsltrace.replay(tmp_path / "run.mcap")
    with prepare_replay(tmp_path / "run.mcap") as plan:
        (code,) = plan.code
        assert code.change == "has changed"
    assert not marker.exists()
    assert rsltrace.replay(tmp_path / "run.mcap", job_folder=tmp_path).is_whole
    assert marker.exists()


def test_looking_at_packages_imports_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the code is, is told before it runs: not even the package around it is imported."""
    package = tmp_path / "pack"
    package.mkdir()
    (package / "__init__.py").write_text("open('ran', 'w').close()\n")
    (package / "nodes.py").write_text(
        "from rclpy.node import Node\nclass N(Node):\n"
        "    def __init__(self): super().__init__('n')\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: pack.nodes:N}]\nstop: {duration: 1s}\n")
    monkeypatch.chdir(tmp_path)
    run(load_job("job.yaml"), "run.mcap")
    Path("ran").unlink()
    with prepare_replay("run.mcap") as plan:
        files = {one.name: one.file for one in plan.code}
    assert files == {"pack": package / "__init__.py", "pack.nodes": package / "nodes.py"}
    assert not Path("ran").exists()


@pytest.mark.long
def test_answers_from_outside_may_be_forged(
    here: Path, recorded: Callable[..., Path], tmp_path: Path
) -> None:
    """A node that unpickles a file would run what a trace says that the file holds."""
    code = "class Watch(Watch):\n    def got(self, m): os.environ.get('HOME')\n"
    recorded(f"{JOB}guard: {{environment: record}}\n", code)
    with pytest.raises(ReplayError, match="recorded answers"):
        rsltrace.replay(here)
    assert rsltrace.replay(here, trust=True).is_whole


def test_what_is_looked_for_and_where(here: Path, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    shutil.move(tmp_path / "job.yaml", tmp_path / "sub")
    with pytest.raises(ReplayError, match=r"looked for job\.yaml in the working directory; n"):
        rsltrace.replay(here)
    with pytest.raises(ReplayError, match="no such folder"):
        rsltrace.replay(here, job_folder="nowhere")


@pytest.mark.parametrize(
    "resolved",
    ["", "[]", "{", '{"nodes": 3}', '{"nodes": [{"node": "x"}]}', '{"bogus": 1}', "1" * 5000],
)
def test_a_job_that_is_none(tmp_path: Path, resolved: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with TraceWriter(Path("run.mcap"), force=False) as writer:
        writer.add_metadata("rsltrace:job", {"name": "<python>", "resolved": resolved})
        writer.add_event(bytes(62), 1)
        writer.close(result={})
    with pytest.raises(ReplayError):
        rsltrace.replay("run.mcap", trust=True)


@pytest.mark.long
def test_on_a_terminal_one_is_asked(
    here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import os
    import pty
    import subprocess
    import sys

    (tmp_path / "above").mkdir()
    for answer, status in (("n", 2), ("y", 0)):
        ours, theirs = pty.openpty()
        process = subprocess.Popen(
            [sys.executable, "-m", "rsltrace", "replay", "../run.mcap", "--json"],
            cwd=tmp_path / "above",
            stdin=theirs,
            stderr=theirs,
            stdout=subprocess.PIPE,
            text=True,
        )
        os.close(theirs)
        os.write(ours, f"{answer}\n".encode())
        out, _ = process.communicate(timeout=600)
        os.close(ours)
        assert process.returncode == status
        assert bool(out) == (status == 0)
        if out:
            assert json.loads(out)["is_whole"]
