# ruff: noqa: E501  the table of messages reads better in one line each
"""Jobs built in Python: the same checks, which raise ``JobError``."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import pytest

from rsltrace.errors import JobError
from rsltrace.job import BagSpec, Job, NodeSpec, StopSpec, TopicStop, load_job


class Talker:
    """Stands in for a node class."""


def make_nodes() -> list[Talker]:
    return [Talker()]


NODE = NodeSpec(node="my_nodes:Talker")


def test_times_are_given_in_seconds_with_units_or_in_nanoseconds() -> None:
    assert StopSpec(duration=10).duration_ns == 10_000_000_000
    assert StopSpec(duration=0.1).duration_ns == 100_000_000
    assert StopSpec(duration="10ms").duration_ns == 10_000_000
    assert StopSpec(duration_ns=10).duration_ns == 10
    assert Job(nodes=[NODE], start_ns=5, construct_time_ns=0).start_ns == 5
    assert BagSpec(path="x", start_offset_ns=7).start_offset_ns == 7


def test_none_means_not_given() -> None:
    assert StopSpec(duration=None, time_ns=None, topic=None, events=None) == StopSpec()
    assert NodeSpec(node="m:N", name=None) == NodeSpec(node="m:N")
    job = Job(nodes=[NODE], executors=None, policy={"order": "fifo", "priority": None})
    assert job == Job(nodes=[NODE], policy="fifo")


def test_parts_may_be_plain_values() -> None:
    job = Job(
        nodes=[{"node": "m:N"}],
        stop={"duration": "1s", "topic": "/done"},
        record={"payloads": False},
    )
    assert job.nodes == (NodeSpec(node="m:N"),)
    assert job.stop == StopSpec(duration_ns=1_000_000_000, topic=TopicStop(name="/done"))
    assert not job.record.payloads


def test_classes_and_functions_are_shown_by_name() -> None:
    name = Talker.__module__
    job = Job(nodes=[NodeSpec(node=Talker), NodeSpec(node=make_nodes)], stop=StopSpec(function=len))
    assert [node.target for node in job.nodes] == [f"{name}:Talker", f"{name}:make_nodes"]
    assert job.nodes[0].node is Talker
    assert job.source_text == (
        f"nodes:\n  - node: {name}:Talker\n  - node: {name}:make_nodes\n"
        "stop:\n  function: builtins:len\n"
    )
    assert job.resolved()["stop"]["function"] == "builtins:len"


def test_paths_are_relative_to_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.yaml").touch()
    job = Job(nodes=[NodeSpec(node="m:N", parameter_files=[Path("p.yaml")])])
    assert job.base_dir == tmp_path
    assert job.resolve(job.nodes[0].parameter_files[0]) == tmp_path / "p.yaml"


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: NodeSpec(node="Talker"), "NodeSpec: node: expected module:Class or module:function, got 'Talker'"),
        (lambda: NodeSpec(node="a.talker"), "NodeSpec: node: expected module:Class or module:function, got 'a.talker'; write a.talker:Class, or a:talker"),
        (lambda: NodeSpec(node=3), "NodeSpec: node: expected module:Class or module:function, got the number 3"),
        (lambda: NodeSpec(nod="m:N"), "NodeSpec: unknown key 'nod'; did you mean 'node'?"),
        (lambda: StopSpec(duration=1, duration_ns=1), "StopSpec: duration_ns: give either duration or duration_ns, not both"),
        (lambda: StopSpec(duration_ns=1.0), "StopSpec: duration: expected an integer number of nanoseconds, got 1.0"),
        (lambda: StopSpec(quiescence_ns=0), "StopSpec: quiescence: must be more than 0"),
        (lambda: Job(), "Job: a job needs at least one node (nodes:), launch file (launch:) or bag (bags:)"),
        (lambda: Job(nodes=NODE), "Job: nodes: expected a list, got an object of NodeSpec"),
        (lambda: Job(nodes=[Talker]), "Job: nodes[0]: expected a mapping, got an object of type"),
        (lambda: Job(nodes=[{"node": "m:N", "nam": "x"}]), "Job: unknown key 'nam' in nodes[0]; did you mean 'name'?"),
        (lambda: Job(nodes=[NODE], bags=["/no/such/bag"]), "Job: bags[0].path: '/no/such/bag': there is no such bag (there is no folder '/no/such' either)"),
        (lambda: Job(nodes=[NODE], seed=2**64), f"Job: seed: must be at most {2**64 - 1}, got {2**64}"),
        (lambda: Job(nodes=[NODE], timer_ties=None), "Job: timer_ties: expected creation or heap, got nothing"),
    ],
)  # fmt: skip
def test_mistakes_raise_job_errors(build: object, message: str) -> None:
    with pytest.raises(JobError) as caught:
        build()  # type: ignore[operator]
    assert str(caught.value) == message


def test_a_job_cannot_be_changed_but_replaced() -> None:
    job = Job(nodes=[NODE], start="1s", stop=StopSpec(duration="2s"), seed=1)
    with pytest.raises(Exception, match="frozen"):
        job.seed = 2
    other = job.replace(seed=2, start_ns=7, stop=job.stop.replace(time="9s"))
    assert (other.seed, other.start_ns) == (2, 7)
    assert (other.stop.duration_ns, other.stop.time_ns) == (2_000_000_000, 9_000_000_000)
    assert other.nodes == job.nodes
    assert job.seed == 1
    with pytest.raises(JobError, match="seed: must be at least 0"):
        job.replace(seed=-1)


def test_replacing_keeps_the_file_a_job_came_from(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_text("nodes: [{node: m:N}]\n", encoding="utf-8")
    job = load_job(path).replace(seed=5)
    assert job.source_name == str(path)
    assert job.source_text == "nodes: [{node: m:N}]\n"
    assert job.base_dir == tmp_path
    assert job.resolved()["seed"] == 5


def test_jobs_can_be_copied_and_sent_to_other_processes() -> None:
    job = Job(nodes=[NodeSpec(node="m:N", parameters={"a": [1, 2]})], stop=StopSpec(events=3))
    assert copy.deepcopy(job) == job
    assert pickle.loads(pickle.dumps(job)) == job


def test_parameters_keep_their_types() -> None:
    values = {"a": True, "b": 1, "c": 1.0, "d": "1", "e": [True], "f": [1], "g": [1.0], "h": ["1"]}
    parameters = NodeSpec(node="m:N", parameters=values).parameters
    assert [type(value) for value in parameters.values()] == [bool, int, float, str] + [tuple] * 4
    assert [type(parameters[name][0]) for name in "efgh"] == [bool, int, float, str]  # type: ignore[index]
