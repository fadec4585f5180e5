"""The command that a diff says to run next: it records the run that it speaks of, and no other."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from rsltrace.diff.causes.record_command import record_again
from rsltrace.diff.sentences.runs import remark_text
from rsltrace.trace.reader import Trace

JOB = """\
nodes:
  - {node: nodes_under_test:Talker, name: a}
  - node: nodes_under_test:Listener
stop: {duration: 3s}   # written in flow style, as the effective job is not
"""


@pytest.mark.long
@pytest.mark.parametrize(
    "given",
    [
        (),
        ("--set", "delay.default.uniform={min: 0s, max: 200ms}", "--seed", "5"),
        ("--until", "2", "--ros-args", "-r", "__ns:=/front"),
    ],
)
def test_a_run_is_recorded_again(
    rsltrace: Any, job_file: Any, tmp_path: Path, given: tuple[str, ...]
) -> None:
    job_file(JOB)
    done = rsltrace("record", "job.yaml", "-o", "run.mcap", *given)
    assert done.returncode == 0, done.stderr
    with Trace.open(tmp_path / "run.mcap") as trace:
        words = shlex.split(record_again(trace).command)
    assert words[:3] == ["rsltrace", "record", str(tmp_path / "job.yaml")], "beside the trace"
    until = ("--until", "2") if "--until" in given else ()
    again = rsltrace(*words[1:], *until, "-o", "again.mcap")
    assert again.stdout == done.stdout, (words, again.stderr)


@pytest.mark.long
def test_where_the_jobs_differ_both_runs_are_to_be_looked_at(rsltrace: Any, job_file: Any) -> None:
    """A third run would say nothing: it is known that the two must differ."""
    job_file(JOB)
    for name, given in (("a", ()), ("b", ("--set", "nodes.a.arguments.period=0.5"))):
        done = rsltrace("record", "job.yaml", "-o", f"{name}.mcap", *given)
        assert done.returncode == 0, done.stderr
    done = rsltrace("diff", "a.mcap", "b.mcap")
    assert done.stdout.endswith("next: rsltrace view a.mcap b.mcap\n"), done.stdout


def test_the_job_is_looked_for_beside_the_trace(rsltrace: Any, tmp_path: Path) -> None:
    """The first diff that `make demo` shows is of traces elsewhere."""
    sample = Path(__file__).parents[2] / "sample_traces" / "nondeterministic_callback"
    here = tmp_path / "samples"
    shutil.copytree(sample, here)
    command = rsltrace("diff", "samples/a.mcap", "samples/b.mcap").stdout.splitlines()[-1]
    assert command.startswith("next: rsltrace record samples/job.yaml --until 2.1")
    inside = rsltrace("diff", "a.mcap", "b.mcap", cwd=here).stdout.splitlines()[-1]
    assert inside.startswith("next: rsltrace record job.yaml --until 2.1")


class _Job:
    """As much of a trace as the command is made of."""

    def __init__(self, name: str, text: str) -> None:
        self.name, self.job, self.job_text = "run.mcap", {"name": name}, text


def _again(name: str, *overrides: str) -> tuple[str, str]:
    lines = "".join(f"#   with --{override}\n" for override in overrides)
    text = f"# The effective job of {name}\n{lines}nodes: []\n#   with --set x=1\n"
    again = record_again(_Job(name, text))  # type: ignore[arg-type]
    return again.command, " ".join(map(remark_text, again.warnings))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with jobs and launch files, one above it and one beside."""
    folder = tmp_path / "here"
    for name in ("job.yaml", "my job.yaml", "x.launch.py", "launch/robot.launch.xml"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("nodes: []\n")
    (tmp_path / "evil.launch.py").write_text("")
    (folder / "link.launch.py").symlink_to(tmp_path / "evil.launch.py")
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize(
    ("name", "override", "command"),
    [
        (
            "robot.launch.xml",
            'set launch.+={"file": "launch/robot.launch.xml", "arguments": {"world": "lab"}}',
            "rsltrace record --launch launch/robot.launch.xml world:=lab",
        ),
        (
            "job.yaml",
            'set launch.+={"file": "x.launch.py", "arguments": {}, "skip_unsupported": true}',
            "rsltrace record job.yaml --launch x.launch.py --skip-unsupported",
        ),
        ("my job.yaml", 'until stop.time="3s"', "rsltrace record 'my job.yaml'"),
        ("job.yaml", "seed seed=5", "rsltrace record job.yaml --set seed=5"),
        (
            "job.yaml",
            "set nodes.ekf.parameters.rate=20.0",
            "rsltrace record job.yaml --set nodes.ekf.parameters.rate=20.0",
        ),
        (
            "job.yaml",
            "set delay.default.uniform={min: 0s, max: 200ms}",
            "rsltrace record job.yaml --set 'delay.default.uniform={min: 0s, max: 200ms}'",
        ),
        (
            "job.yaml",
            'set record.topics=["/scan", /tf*]',
            "rsltrace record job.yaml --set 'record.topics=[\"/scan\", /tf*]'",
        ),
    ],
)
def test_options_are_said_again(here: Path, name: str, override: str, command: str) -> None:
    assert _again(name, override) == (command, "")


def test_ros_arguments_are_said_again(here: Path) -> None:
    words = ("-r", "__ns:=/front", "-p", "ekf:rate:=20.0")
    given = [f"set ros_arguments.+={json.dumps(word)}" for word in words]
    command = "rsltrace record job.yaml --ros-args -r __ns:=/front -p ekf:rate:=20.0 --"
    assert _again("job.yaml", *given) == (command, "")


@pytest.mark.parametrize(
    "override",
    [
        "set nodes=[{main: timeit:main, name: x}]",
        "set nodes.+={node: canary:hit}",
        "set nodes.ekf.node=canary:hit",
        "set nodes.ekf.parameters.model=/elsewhere/evil.pkl",
        "set nodes.ekf.parameters.hook=canary:hit",
        "set hooks={after: canary:hit}",
        "set policy=canary:hit",
        "set policy={function: canary.hit}",
        "set search_path=[/elsewhere]",
        "set delay=[/elsewhere/delays.yaml]",
        "set launch.+=x.launch.py",
        'set launch.+={"file": "/elsewhere/evil.launch.py", "arguments": {}}',
        'set launch.+={"file": "../evil.launch.py", "arguments": {}}',
        'set launch.+={"file": "link.launch.py", "arguments": {}}',
        'set launch.+={"file": "gone.launch.py", "arguments": {}}',
        'set launch.+={"file": "x.launch.py", "arguments": {"map": "$(rm x)"}}',
        'set launch.+={"file": "x.launch.py", "arguments": {"-o": "x"}}' + "\x1b]0;owned\x07",
        'set ros_arguments.+="--params-file"',
        'set ros_arguments.+="x:=1"',
        "launch evil.launch.py",
        "output canary",
        "set seed=5; touch canary",
        "set seed=" + "1" * 100_000,
        "set stop.time=" + "[" * 100_000,
    ],
)
def test_what_may_run_code_is_told_and_not_offered(here: Path, override: str) -> None:
    """A trace may come from anybody, and the line is there to be pasted."""
    command, warning = _again("job.yaml", override)
    assert command == ""
    assert "no command to reproduce this" in warning
    assert "\x1b" not in warning
    assert len(warning) < 1000


@pytest.mark.parametrize("name", ["../job.yaml", "gone.yaml", "--launch=x.launch.py", "é" * 3000])
def test_a_job_that_is_not_here_is_not_offered(here: Path, name: str) -> None:
    (here.parent / "job.yaml").write_text("nodes: []\n")
    command, warning = _again(name)
    assert command == ""
    assert "no command to reproduce this: the job" in warning


def test_another_job_of_that_name_is_told(here: Path) -> None:
    mine = _Job("job.yaml", "nodes: []\n")
    assert record_again(mine).warnings == ()  # type: ignore[arg-type]
    theirs = record_again(_Job("job.yaml", "nodes: [x]\n"))  # type: ignore[arg-type]
    assert theirs.command == "rsltrace record job.yaml"
    assert "or the trace is of another job" in remark_text(theirs.warnings[0])


@pytest.mark.parametrize("name", ["", "<python>"])
def test_a_job_of_no_file_is_not_recorded_again(name: str) -> None:
    assert _again(name) == ("", "")


@pytest.mark.long
def test_a_job_made_in_python_has_no_file_and_no_lines(tmp_path: Path) -> None:
    from rsltrace import Job, NodeSpec, StopSpec, diff, record

    for seed in (1, 2):
        nodes = [NodeSpec(node=_drawing_node)]
        job = Job(nodes=nodes, seed=seed, stop=StopSpec(duration="1s"))
        record(job, tmp_path / f"{seed}.mcap")
    found = diff(tmp_path / "1.mcap", tmp_path / "2.mcap")
    (setting,) = found.settings
    assert (setting.place, setting.key, setting.a, setting.b) == ("job", "seed", "1", "2")


def _drawing_node() -> Any:
    import random

    from rclpy.node import Node
    from std_msgs.msg import Float64

    class Drawing(Node):
        def __init__(self) -> None:
            super().__init__("drawing")
            self.sender = self.create_publisher(Float64, "drawn", 1)
            self.create_timer(0.5, self.tick)

        def tick(self) -> None:
            self.sender.publish(Float64(data=random.random()))

    return Drawing()


@pytest.mark.long
def test_which_run_an_exception_ended_is_told(rsltrace: Any, job_file: Any) -> None:
    """Where runs diverge by something else, that is what one wants to know of a run that failed."""
    code = """
class Fragile(Listener):
    def got(self, message):
        super().got(message)
        assert message.data < 3, 'too much'
"""
    job_file(JOB.replace("Listener", "Fragile").replace("3s", "5s"), code)
    assert rsltrace("record", "job.yaml", "-o", "b.mcap").returncode == 3
    late = ("--set", "delay.default.constant=10ms", "--until", "2")
    assert rsltrace("record", "job.yaml", "-o", "a.mcap", *late).returncode == 0
    note = "ended with an exception (event "
    assert f"\nnote: b {note}" in rsltrace("diff", "a.mcap", "b.mcap").stdout
    assert f"\nnote: a {note}" in rsltrace("diff", "b.mcap", "a.mcap").stdout
    several = rsltrace("diff", "a.mcap", "a.mcap", "b.mcap").stdout
    assert f"\nb.mcap {note}" in several
    assert note not in rsltrace("diff", "b.mcap", "b.mcap").stdout
