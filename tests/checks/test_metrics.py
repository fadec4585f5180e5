"""Metrics of a job: numbers from traces, and what is said where there is none."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace import Job, MetricResult, NodeSpec, Trace, evaluate_metrics, load_job
from rsltrace.checks.metrics import check_metrics
from rsltrace.errors import CheckError, JobError

A = Path(__file__).parents[2] / "sample_traces" / "nondeterministic_callback" / "a.mcap"
Command = Callable[..., subprocess.CompletedProcess[str]]


def worth(load: Any = None, **metrics: Any) -> dict[str, MetricResult]:
    with Trace.open(A) as trace:
        job = Job(nodes=[NodeSpec(node="m:N")], metrics=metrics)
        return {one.name: one for one in evaluate_metrics(trace, job, load)}


def test_a_metric_is_what_python_says_of_the_messages() -> None:
    with Trace.open(A) as trace:
        sent = [
            (stamp, trace.decode("/cmd_vel", data)) for stamp, _, data in trace.messages("/cmd_vel")
        ]
        start_ns, events = trace.start_ns, trace.event_count
    found = worth(
        fastest={"expression": 'max(m.linear.x for m in messages("/cmd_vel"))', "unit": "m/s"},
        events="events",
        first='times("/cmd_vel")[0]',
        moved='count("/cmd_vel") > 3',
        nothing='last("/nowhere").data',
        apart="1 / (events - events)",
    )
    speeds = [m.linear.x for _, m in sent]  # type: ignore[attr-defined]
    assert found["fastest"] == MetricResult("fastest", max(speeds), "m/s")
    assert found["fastest"].text == f"{max(speeds):.6g} m/s"
    assert found["events"].value == events
    assert found["first"].value == (sent[0][0] - start_ns) / 1e9
    assert found["moved"].value == 1.0
    assert found["nothing"].value is None
    assert "there is no topic /nowhere" in found["nothing"].note
    assert (found["apart"].value, found["apart"].text) == (None, "none")


def test_functions_are_called_for_a_job_and_not_for_a_trace() -> None:
    called = {"function": "m:f", "unit": "J"}
    assert worth(lambda target: lambda trace: 3, f=called)["f"].text == "3 J"
    assert worth(lambda target: lambda trace: None, f=called)["f"].value is None
    assert "are called for a job's file" in worth(f=called)["f"].note
    with pytest.raises(CheckError, match="metric f: m:f is a str, not a number"):
        worth(lambda target: lambda trace: "3", f=called)
    with pytest.raises(CheckError, match="metric f: m:f raised ZeroDivisionError"):
        worth(lambda target: lambda trace: 1 / 0, f=called)
    with pytest.raises(CheckError, match="is a list, not a number"):
        worth(f='messages("/cmd_vel")')


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("speed: last('/x').__class__", "job.yaml:3:10: metric speed: .* no field of a message"),
        ("speed: 3", "expected text"),
        ("speed: {unit: m}", "give expression or function"),
        ("'': events", "is no name"),
    ],
)
def test_a_metric_that_is_none_is_refused_with_its_line(
    tmp_path: Path, text: str, said: str
) -> None:
    (tmp_path / "job.yaml").write_text(f"nodes: [{{node: 'm:N'}}]\nmetrics:\n  {text}\n")
    with pytest.raises(JobError, match=said):
        check_metrics(load_job(tmp_path / "job.yaml"))


def test_the_commands_show_metrics(command: Command, tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text(
        "nodes: [{node: 'm:N'}]\nmetrics:\n  commands: {expression: 'count(\"/cmd_vel\")', "
        "unit: messages}\n  lost: 'first(\"/lost\").data'\n"
    )
    shown = command("check", A, "--job", "job.yaml")
    assert shown.returncode == 0
    first, second = shown.stdout.splitlines()
    count = first.removeprefix("metric commands: ").removesuffix(" messages")
    assert int(count) > 0
    assert second.startswith("metric lost: none (it has no value there: there is no topic /lost")
    values = json.loads(command("check", A, "--job", "job.yaml", "--format", "json").stdout)
    assert values["metrics"]["commands"] == {"value": float(count), "unit": "messages", "note": ""}
    assert values["metrics"]["lost"]["value"] is None
