"""``on_exception: log``: a callback that raises is news in the trace, not the end of the run."""

from __future__ import annotations

from typing import Any

import pytest

from rsltrace.errors import NodeError
from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind
from rsltrace.trace.reader import Trace

FLAKY = """
class Flaky(Listener):
    def __init__(self):
        super().__init__()
        self.create_timer(0.5, self.beat)
        self.create_timer(1.0, self.later)
        self.beats = 0

    def got(self, message):
        if message.data % 2 == 0:
            raise ValueError(f'{message.data} is even')
        super().got(message)

    def beat(self):
        self.beats += 1
        if self.beats == 3:
            raise RuntimeError('third beat')
        self.get_logger().info(f'beat {self.beats}')

    async def later(self):
        if self.beats == 4:
            raise KeyError('in a coroutine')
        self.get_logger().info('later')

class Refused(Listener):
    def __init__(self):
        super().__init__()
        raise ValueError('no')
"""

JOB = """
nodes:
  - node: nodes_under_test:Talker
  - {node: nodes_under_test:Flaky, on_exception: %s}
stop: {duration: 5s}
"""


def test_the_run_goes_on_and_the_trace_says_what_was_raised(record_job: Any) -> None:
    result = record_job(JOB % "log", FLAKY)
    assert result.error is None
    assert result.exit_code == 0
    assert result.end_ns == 5_000_000_000
    raised = []
    with Trace.open(result.path) as trace:
        for index in range(trace.event_count):
            event, outputs = trace.event(index), trace.outputs_of(index)
            if event.flags & EventFlag.RAISED:
                assert [o.kind for o in outputs][-2:] == [OutputKind.EXCEPTION, OutputKind.LOG]
                _, topic, data = trace.payload(outputs[-1])
                record = trace.decode(topic, data)
                raised.append((event.kind, record.level, record.msg))
    assert (
        EventKind.SUBSCRIPTION,
        40,
        "/listener: subscription /numbers raised ValueError: 2 is even",
    ) in raised
    assert [kind for kind, _, _ in raised].count(EventKind.SUBSCRIPTION) == 2
    assert sum("third beat" in text for _, _, text in raised) == 1
    assert sum("in a coroutine" in text for _, _, text in raised) == 1


def test_without_it_the_first_exception_ends_the_run(record_job: Any) -> None:
    result = record_job(JOB % "stop", FLAKY)
    assert isinstance(result.error, NodeError)
    assert result.end_ns == 1_500_000_000


def test_a_node_that_cannot_be_made_ends_the_run_all_the_same(record_job: Any) -> None:
    result = record_job(JOB.replace("Flaky", "Refused") % "log", FLAKY)
    assert isinstance(result.error, NodeError)


@pytest.mark.long
def test_runs_with_exceptions_are_deterministic(record_job: Any) -> None:
    digests = {record_job(JOB % "log", FLAKY).digest for _ in range(3)}
    assert len(digests) == 1


@pytest.mark.long
@pytest.mark.parametrize("policy", ["stop", "log"])
def test_system_exit_is_never_only_logged(record_job: Any, policy: str) -> None:
    code = FLAKY.replace("raise RuntimeError('third beat')", "raise SystemExit(7)")
    result = record_job(
        (JOB % policy).replace("Talker", "Talker\n    arguments: {period: 100}"), code
    )
    assert result.exit_code == 7


def test_it_holds_for_nodes_that_are_made_after_a_wait(record_job: Any) -> None:
    code = """
from rclpy.duration import Duration

def both():
    first = Listener()
    first.get_clock().sleep_for(Duration(seconds=0.1))
    second = Node('second')
    second.create_timer(1.0, lambda: 1 / 0)
    return [first, second]
"""
    yaml = "nodes: [{node: nodes_under_test:both, on_exception: log}]\nstop: {duration: 2s}\n"
    result = record_job(yaml, code)
    assert result.error is None
    assert result.end_ns == 1_100_000_000  # it has raised
    assert result.stop_reason == "duration of 2.000000000 s"
