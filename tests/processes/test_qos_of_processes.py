"""QoS events of processes: both ends of many pairs go through what nodes here go through."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace import Job, NodeSpec, StopSpec, Trace
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.event import EventKind

pytestmark = pytest.mark.ros

MATRIX = Path(__file__).parents[1] / "middleware" / "qos_matrix.py"
JOB = """
nodes:
  - {{script: {script}, isolated: true, arguments: [offers, offers.json, {executor}]}}
  - {{script: {script}, isolated: true, arguments: [asks, asks.json, {executor}]}}
stop: {{duration: 3.5s}}
"""


def _here() -> list[list[dict[str, Any]]]:
    spec = importlib.util.spec_from_file_location("qos_matrix", MATRIX)
    assert spec is not None
    assert spec.loader is not None
    matrix = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(matrix)
    nodes: list[Any] = []

    def make(cls: Any) -> Callable[[], Any]:
        def node() -> Any:
            nodes.append(cls(1, 60))
            return nodes[-1]

        return node

    specs = [NodeSpec(node=make(end)) for end in (matrix.Offers, matrix.Asks)]
    run(Job(nodes=specs, stop=StopSpec(duration=3.0)), None)
    return [node.outcomes for node in nodes]


@pytest.mark.long
@pytest.mark.parametrize("executor", ["", pytest.param("events", marks=pytest.mark.long)])
def test_all_pairs_go_through_the_same_in_processes(
    compiled: object,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    executor: str,
) -> None:
    here = _here()
    script = Path(__file__).with_name("qos_ends.py")
    (tmp_path / "job.yaml").write_text(JOB.format(script=script, executor=executor or "single"))
    monkeypatch.chdir(tmp_path)
    result = run(load_job(tmp_path / "job.yaml"), tmp_path / "t.mcap")
    assert result.error is None
    beside = [json.loads((tmp_path / f"{end}.json").read_text()) for end in ("offers", "asks")]
    differing = [
        (number, *ends)
        for number, ends in enumerate(zip(*here, *beside, strict=True))
        if ends[:2] != ends[2:]
    ]
    assert not differing
    assert {end["incompatible"] for end in beside[1]} >= {0, 4, 8, 16}
    assert {end["lost"] for end in beside[0]} == {0, 1}
    with Trace.open(tmp_path / "t.mcap") as trace:
        kinds = {trace.event(number).kind for number in range(trace.event_count)}
    assert EventKind.QOS_EVENT in kinds
