"""The command that a diff says to run next: it records the run that it speaks of, and no other."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from rsltrace.diff.causes.record_command import record_command
from rsltrace.trace.reader import Trace

JOB = """\
nodes:
  - {node: nodes_under_test:Talker, name: a}
  - node: nodes_under_test:Listener
stop: {duration: 3s}   # written in flow style, as the effective job is not
"""


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
        words = shlex.split(record_command(trace))
    assert words[:3] == ["rsltrace", "record", str(tmp_path / "job.yaml")], "beside the trace"
    until = ("--until", "2") if "--until" in given else ()
    again = rsltrace(*words[1:], *until, "-o", "again.mcap")
    assert again.stdout == done.stdout, (words, again.stderr)


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


@pytest.mark.parametrize(
    ("name", "override", "command"),
    [
        ("", "", ""),
        ("<python>", "--set x=1", ""),
        (
            "robot.launch.xml",
            '--set launch.+={"file": "launch/robot.launch.xml", "arguments": {"world": "a lab"}}',
            "rsltrace record --launch launch/robot.launch.xml 'world:=a lab'",
        ),
        (
            "job.yaml",
            '--set launch.+={"file": "x.launch.py", "arguments": {}, "skip_unsupported": true}',
            "rsltrace record job.yaml --launch x.launch.py --skip-unsupported",
        ),
        ("job.yaml", "--set launch.+=x.xml", "rsltrace record job.yaml --set launch.+=x.xml"),
        ("my job.yaml", '--until stop.time="3s"', "rsltrace record 'my job.yaml'"),
    ],
)
def test_launch_files_and_names(name: str, override: str, command: str) -> None:
    text = f"# The effective job of {name}\n#   with {override}\nnodes: []\n#   with --set x=1\n"
    assert record_command(_Job(name, text)) == command  # type: ignore[arg-type]


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
    note = "ended by an exception: /listener: subscription /numbers raised AssertionError, event "
    assert f"\nnote: b {note}" in rsltrace("diff", "a.mcap", "b.mcap").stdout
    assert f"\nnote: a {note}" in rsltrace("diff", "b.mcap", "a.mcap").stdout
    several = rsltrace("diff", "a.mcap", "a.mcap", "b.mcap").stdout
    assert f"\nb.mcap {note}" in several
    assert note not in rsltrace("diff", "b.mcap", "b.mcap").stdout
