"""``policy:``, ``executors:``, ``execution:`` and ``clocks:`` of a job, and mistakes in them."""

from __future__ import annotations

from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path

import pytest

from rsltrace.errors import JobError
from rsltrace.job import Job, load_job
from rsltrace.run.plans.network import clock_rules
from rsltrace.run.plans.scheduling import is_ordered, scheduling_plan
from rsltrace.simulation.chance.stream import ClockModel

MS = 1_000_000


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def load(keys: str) -> Job:
    Path("job.yaml").write_text("nodes: [{node: 'a:B'}]\n" + keys + "\n", encoding="utf-8")
    return load_job("job.yaml")


def test_a_job_is_ordered_when_it_says_so() -> None:
    assert not is_ordered(load(""))
    assert not is_ordered(load("policy: fifo"))
    for keys in ("policy: permutation", "executors: single_threaded", "execution: {default: 1ms}"):
        assert is_ordered(load(keys))


def test_a_recording_may_be_left_for_another_policy() -> None:
    begun = "policy: {recorded: job.yaml, after: 2s"
    for more, plain in ((", pct: 2, seed: 1}", False), (", departures: []}", False), ("}", True)):
        policy = load(begun + more).policy
        assert policy is not None
        assert policy.begins_recorded
        assert policy.is_plain == plain
        assert load_job("job.yaml").resolved()["policy"]["after_ns"] == 2000 * MS
    changed = load_job("job.yaml", overrides=["policy.order=permutation"]).policy
    assert changed is not None
    assert (changed.recorded, changed.order) == ("job.yaml", "permutation")
    whole = load("policy: {recorded: job.yaml}").policy
    assert whole is not None
    assert not whole.begins_recorded
    assert not whole.is_plain


def test_executors_and_execution_times() -> None:
    pytest.importorskip("rclpy")
    job = load(
        "executors: [{nodes: [/a, /b*], workers: 2}]\n"
        "execution:\n"
        "  default: 1ms\n"
        "  nodes: {/a: {uniform: {min: 1ms, max: 2ms}}}\n"
        "  entities: [{node: /a, entity: /t, constant: 3ms}]\n"
    )
    with ExitStack() as stack:
        plan = scheduling_plan(job, 5, stack)
    assert [(rule.nodes, rule.workers) for rule in plan.executors] == [(("/a", "/b*"), 2)]
    assert [(rule.node, rule.entity) for rule in plan.execution] == [
        ("/a", "/t"),
        ("/a", None),
        ("*", None),
    ]
    Path("again.yaml").write_text(job.to_yaml())
    assert load_job("again.yaml").execution == job.execution
    assert load_job("again.yaml").executors == job.executors


def test_clocks() -> None:
    job = load(
        "clocks:\n"
        "  - {node: /a, offset: -20ms, drift: 50ppm,\n"
        "     jumps: [{at: 1s, by: -0.5}, {at: 2s, by: 1s}]}\n"
        "  - {node: '*', random_jumps: {every: 10s, most: 5ms}}\n"
    )
    assert tuple((rule.node, rule.model) for rule in clock_rules(job)) == (
        (
            "/a",
            ClockModel(
                -20 * MS,
                Fraction(50.0) / 10**6,
                ((1000 * MS, -500 * MS), (2000 * MS, 1000 * MS)),
            ),
        ),
        ("*", ClockModel(random_every_ns=10_000 * MS, random_most_ns=5 * MS)),
    )


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            "policy: fifoo",
            "job.yaml:2:9: policy: expected fifo or rate_monotonic or wait_set or rclpy or "
            "permutation, or a mapping "
            "with priority or departures or pct or recorded or function, got text 'fifoo'; did you "
            "mean fifo?",
        ),
        (
            "policy: {order: fifo, recorded: job.yaml}",
            "job.yaml:2:9: policy: give one of order, priority, departures, pct, recorded, "
            "function; recorded with another one needs after, too",
        ),
        (
            "policy: {recorded: job.yaml, after: 1s, pct: 2, order: fifo}",
            "job.yaml:2:9: policy: give one of order, priority, departures, pct, recorded, "
            "function",
        ),
        (
            "policy: {departures: [], after: 1s}",
            "job.yaml:2:26: policy: departures say themselves from when on",
        ),
        ("policy: {prio: 5}", "job.yaml:2:10: unknown key 'prio' in policy; did you mean"),
        (
            "policy: {priority: [{node: /a}]}",
            "job.yaml:2:21: policy.priority[0]: the key 'priority' is missing",
        ),
        (
            "policy: {priority: [{priority: high}]}",
            "job.yaml:2:32: policy.priority[0].priority: expected an integer, got text 'high'",
        ),
        (
            "policy: {recorded: gone.mcap}",
            "job.yaml:2:20: policy.recorded: 'gone.mcap': there is no such file",
        ),
        (
            "policy: permutation\ntimer_ties: heap",
            "job.yaml:3:13: timer_ties: heap is the order of RSLCPP's timers",
        ),
        (
            "executors: many",
            "job.yaml:2:12: executors: expected single_threaded or per_node or a list of "
            "executors, got text 'many'",
        ),
        (
            "executors: [{workers: 0}]",
            "job.yaml:2:23: executors[0].workers: must be at least 1, got 0",
        ),
        (
            "execution: {nodes: {/a: {mean: 5ms}}}",
            "job.yaml:2:26: unknown key 'mean' in execution.nodes./a",
        ),
        (
            "execution: {entities: [{node: /a, constant: 5ms}]}",
            "job.yaml:2:24: execution.entities[0]: the key 'entity' is missing",
        ),
        (
            "clocks: [{node: /a, drift: fast}]",
            "job.yaml:2:28: clocks[0].drift: expected parts per million such as 50ppm, got text "
            "'fast'",
        ),
        (
            "clocks: [{node: /a, jumps: [{at: 2s, by: 1s}, {at: 1s, by: 1s}]}]",
            "job.yaml:2:52: clocks[0].jumps[1].at: it is before the jump above",
        ),
        ("min_time_step: -1ms", "job.yaml:2:16: min_time_step: a time must not be negative"),
    ],
)
def test_mistakes_are_shown_where_they_are(keys: str, message: str) -> None:
    with pytest.raises(JobError) as caught:
        load(keys)
    assert str(caught.value).splitlines()[0].startswith(message)
