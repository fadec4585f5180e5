"""A trace from anybody: what its job says is computed within bounds, and none of it is run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from rsltrace import Trace, load_job, record
from rsltrace.adapters.launch.model import yaml_value
from rsltrace.cli.main import cli
from rsltrace.errors import JobError
from rsltrace.trace.recordings.topic import parse_qos
from tests.trace.make import write_run

HARM = (
    """/count: np.load.__globals__["os"].system("id > PWNED") == 0""",
    """/count: np.save("PWNED", np.zeros(3)) is None""",
    """/count: __import__("pathlib").Path("PWNED").touch() is None""",
    "/count: 9**9**9 > 1",
    "/count: 'a' * 10**10 != ''",
    "log /(?=b)(a+)+/",
)
METRICS = (
    """len(messages("/count").__class__.__subclasses__())""",
    """eval("open('PWNED', 'w')")""",
    "9**9**9",
)
READING: dict[str, Callable[[str], list[str]]] = {
    "check": lambda trace: ["check", trace],
    "view": lambda trace: ["view", trace, "--export", "view.txt"],
    "info": lambda trace: ["info", trace, "--check"],
    "cat": lambda trace: ["cat", trace, "--json", "--payloads"],
    "diff": lambda trace: ["diff", trace, trace],
    "export": lambda trace: ["export", trace, "-o", "bag", "--layout", "layout.json"],
    "rerun": lambda trace: ["rerun", trace, "-o", "view.rrd"],
}


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _harmless(folder: Path, words: list[str]) -> tuple[int, str]:
    done = CliRunner().invoke(cli, words)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exc_info
    assert not list(folder.rglob("PWNED*"))
    return done.exit_code, done.output


@pytest.mark.parametrize("harm", HARM)
@pytest.mark.parametrize("command", READING)
def test_no_command_that_reads_runs_what_checks_say(folder: Path, command: str, harm: str) -> None:
    if command == "rerun":
        pytest.importorskip("rerun")
    if command == "view":
        pytest.importorskip("textual")
    write_run(folder / "evil.mcap", 60, checks=f"checks:\n  - never: {_quoted(harm)}\n")
    status, said = _harmless(folder, READING[command]("evil.mcap"))
    if command == "check":
        assert status == 2
        assert "the job of evil.mcap:5:12: never: " in said
    elif command == "view":
        assert "checks not evaluated: the job of evil.mcap" in (folder / "view.txt").read_text()


@pytest.mark.parametrize("metric", METRICS)
def test_no_metric_of_a_trace_runs(folder: Path, metric: str) -> None:
    write_run(folder / "evil.mcap", 60, checks=f"metrics:\n  m: {_quoted(metric)}\n")
    status, said = _harmless(folder, ["check", "evil.mcap"])
    assert status == 2
    assert "metric m: " in said


@pytest.mark.parametrize("harm", HARM)
def test_conditions_of_the_command_line_are_of_the_same_language(folder: Path, harm: str) -> None:
    write_run(folder / "run.mcap", 60)
    assert _harmless(folder, ["cat", "run.mcap", "--where", harm])[0] == 2
    pytest.importorskip("textual")
    words = ["view", "run.mcap", "--filter", harm, "--export", "view.txt"]
    if harm.startswith("/"):
        assert _harmless(folder, words)[0] == 2


def test_cat_shows_the_events_of_which_a_condition_is_true(folder: Path) -> None:
    write_run(folder / "run.mcap", 60)
    with Trace.open(folder / "run.mcap") as trace:
        sent = [trace.decode("/count", data).data for _, _, data in trace.messages("/count")]  # type: ignore[attr-defined]
    limit = sorted(sent)[len(sent) // 2]
    below = sum(1 for data in sent if data < limit)
    for where in (f"/count: data < {limit}", f"/count.data < {limit}"):
        _, said = _harmless(folder, ["cat", "run.mcap", "--where", where])
        lines = said.splitlines()
        assert len([line for line in lines if "timer" in line]) == below
        assert len([line for line in lines if "subscription" in line]) == below
        assert len(lines) == 2 * below
    _, said = _harmless(folder, ["cat", "run.mcap", "--where", "exception ValueError"])
    assert len(said.splitlines()) == 1


@pytest.mark.ros
@pytest.mark.parametrize("harm", HARM)
def test_a_jobs_own_checks_obey_the_same(folder: Path, harm: str) -> None:
    (folder / "job.yaml").write_text(
        "nodes: [{node: 'no_module:Talker'}]\nstop: {duration: 1s}\n"
        f"checks:\n  - never: {_quoted(harm)}\n"
    )
    for words in (["record", "job.yaml", "-o", "x.mcap"], ["check", "job.yaml"]):
        status, said = _harmless(folder, words)
        assert status != 0
        assert "job.yaml:4:12: never: " in said
    with pytest.raises(JobError):
        record(load_job("job.yaml"), folder / "x.mcap")


@pytest.mark.parametrize(
    "tag",
    [
        "!!python/object/apply:os.system ['touch PWNED']",
        "!!python/object/new:pathlib.Path [PWNED]",
        "!!python/name:os.system",
        "!!python/module:antigravity",
    ],
)
def test_tags_of_yaml_make_no_objects(folder: Path, tag: str) -> None:
    """In metadata and QoS profiles of bags, parameter files, launch files, jobs."""
    text = f"rosbag2_bagfile_information: {tag}\n"
    assert yaml_value(text) == text
    with pytest.raises(ValueError, match="not YAML"):
        parse_qos(f"- history: {tag}\n")
    bag = folder / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text(text)
    (bag / "bag_0.mcap").write_bytes(b"")
    (folder / "job.yaml").write_text(f"nodes: {tag}\n")
    assert _harmless(folder, ["info", "bag"])[0] == 2
    assert _harmless(folder, ["check", "job.yaml"])[0] != 0
