"""Driving a graph from outside: it must do what a recording of the same job does, until somebody
outside does something, which the trace then tells apart from what the nodes do."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import rsltrace
from rsltrace import Job, NodeSpec, RunResult, Simulation, StopSpec, Trace
from rsltrace.errors import DeadlockError, NodeError, OutputError, RunError, UnsupportedError
from rsltrace.trace.model.event import NO_EVENT, EventKind

pytestmark = pytest.mark.ros

BOTH = "nodes: [{node: nodes_under_test:Talker}, {node: nodes_under_test:Listener}]\n"

MORE = """
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from std_srvs.srv import Trigger

class Echo(Node):
    def __init__(self):
        super().__init__('echo')
        self.heard = []
        self.publisher = self.create_publisher(UInt64, 'echoed', 10)
        self.create_subscription(UInt64, 'numbers', self.got, 10)

    def got(self, message):
        self.heard.append((self.get_clock().now().nanoseconds, message.data))
        if message.data == 13:
            raise ValueError('thirteen')
        self.publisher.publish(message)

    def say(self, value):
        self.publisher.publish(UInt64(data=value))
        return 'said'

class Server(Node):
    def __init__(self):
        super().__init__('server')
        self.create_service(Trigger, 'trigger', self.answer)

    def answer(self, request, response):
        self.get_clock().sleep_for(rclpy.duration.Duration(seconds=2))
        response.message = 'done'
        return response

class Sleeper(Node):
    def __init__(self):
        super().__init__('sleeper')
        self.create_timer(0.3, self.tick)
        self.create_timer(0.1, lambda: None)

    def tick(self):
        self.get_clock().sleep_for(rclpy.duration.Duration(seconds=0.25))
        self.get_logger().info('woke')
"""


@pytest.fixture
def simulate(job_file: Callable[..., Path]) -> Callable[..., Simulation]:
    """Write a job and make a simulation of it."""

    def make(yaml: str, output: Path | None = None) -> Simulation:
        return Simulation(job_file(yaml, MORE), output)

    return make


# -- the same run ----------------------------------------------------------------------------------

STOPS = [
    "{duration: 3.5s}",
    "{duration: 4s}",
    "{events: 17}",
    "{topic: /numbers}",
    "{time: 12.25s}",
]
TALK = "nodes: [{node: nodes_under_test:Talker}, {node: nodes_under_test:Echo}]\n"
GRAPH = BOTH + "start: 10s\nguard: false\n"
BLOCKING = (
    "nodes: [{node: nodes_under_test:Sleeper}, {node: nodes_under_test:Talker}]\n"
    "start: 10s\nguard: false\n"
)

SETTINGS = [
    "",
    "delay: {default: {uniform: {min: 0ms, max: 300ms}}}\n",
    "policy: permutation\nmin_time_step: 130ms\n",
    "execution: {default: 170ms}\nexecutors: single_threaded\n",
]
MAIN = """
def main():
    rclpy.init()
    node = Echo()
    try:
        rclpy.spin(node)
    finally:
        node.get_logger().info('goodbye')
        node.destroy_node()
"""
MAINS = (
    "nodes: [{main: nodes_under_test:main}, {node: nodes_under_test:Talker}]\n"
    "start: 10s\nguard: false\n"
)


def drive_by(sim: Simulation, pieces: list[Any]) -> None:
    for piece in pieces:
        if sim.done:
            return
        if piece == "step":
            sim.step()
        elif piece == "run":
            sim.run()
        elif piece == "goal":
            sim.run_until(lambda: sim.events % 5 == 0, timeout="0.7s")
        else:
            sim.run_for(f"{piece}ms")


@pytest.mark.long
@settings(
    max_examples=15,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
@given(
    graph=st.sampled_from([GRAPH, BLOCKING, MAINS]),
    setting=st.sampled_from(SETTINGS),
    stop=st.sampled_from(STOPS),
    pieces=st.lists(
        st.one_of(st.integers(0, 3000), st.sampled_from(["step", "goal"])), max_size=12
    ),
    listen=st.booleans(),
)
def test_driving_leaves_no_mark(
    job_file: Any,
    tmp_path: Path,
    graph: str,
    setting: str,
    stop: str,
    pieces: list[Any],
    listen: bool,
) -> None:
    job = rsltrace.load_job(job_file(f"{graph}{setting}stop: {stop}\n", MORE + MAIN))
    recorded = rsltrace.record(job, tmp_path / "recorded.mcap", force=True)
    with Simulation(job, tmp_path / "driven.mcap", force=True) as sim:
        if listen:
            sim.subscribe("/numbers", lambda message: None)
        drive_by(sim, [*pieces, "run"])
    assert sim.result == replace(recorded, path=tmp_path / "driven.mcap")
    assert (tmp_path / "driven.mcap").read_bytes() == (tmp_path / "recorded.mcap").read_bytes()


def test_leaving_between_two_steps_is_stopping_there(simulate: Any, tmp_path: Path) -> None:
    job = simulate(GRAPH)._session.job
    stopped = job.replace(stop=StopSpec(time="12.5s"))
    recorded = rsltrace.record(stopped, tmp_path / "recorded.mcap")
    with Simulation(job, tmp_path / "driven.mcap") as sim:
        sim.run_until("2.5s")
        assert sim.now_ns == 12_500_000_000
        assert sim.node("talker").get_clock().now().nanoseconds == 12_500_000_000
    assert sim.result.digest == recorded.digest
    assert sim.result.end_ns == recorded.end_ns == 12_000_000_000
    assert sim.result.stop_reason == "left by the driver of the simulation"


@pytest.mark.long
def test_a_job_without_an_end_ends_when_nothing_is_left(simulate: Any) -> None:
    with simulate("nodes: [{node: nodes_under_test:Echo}]\n") as sim:
        assert not sim.step()
        assert not sim.done
        assert sim.run_for(5)
        assert sim.now_ns == 5 * 10**9
        sim.publish("numbers", _number(1))
        assert sim.step()
        assert sim.node("echo").heard == [(5 * 10**9, 1)]
    assert sim.result.stop_reason == "nothing left to do"
    assert sim.result.exit_code == 0


# -- going on --------------------------------------------------------------------------------------


def _number(value: int) -> Any:
    from std_msgs.msg import UInt64

    return UInt64(data=value)


def test_steps_and_times(simulate: Any) -> None:
    with simulate(GRAPH) as sim:
        assert (sim.now_ns, sim.done, sim.node("talker").count) == (10 * 10**9, False, 0)
        assert sim.step()
        assert (sim.now_ns, sim.node("talker").count, sim.node("listener").total) == (
            11 * 10**9,
            1,
            1,
        )
        sim.run_for("2500ms")
        assert (sim.now_ns, sim.node("talker").count) == (13_500_000_000, 3)
        sim.run_for(0.5)
        assert (sim.now_ns, sim.node("talker").count) == (14 * 10**9, 4)
        assert sim.run_until(lambda: sim.node("listener").total >= 15)
        assert sim.now_ns == 15 * 10**9
        assert not sim.run_until(lambda: False, timeout="1.25s")
        assert sim.now_ns == 16_250_000_000
        with pytest.raises(RunError, match=r"6\.250000000 s already, past -7\.000000000 s"):
            sim.run_until("@3s")


def test_the_jobs_own_end_is_done(simulate: Any) -> None:
    with simulate(GRAPH + "stop: {duration: 3.5s}\n") as sim:
        times = []
        while not sim.done:
            sim.run_for(0.5)
            times.append(sim.now_ns)
        assert len(times) == 7
        assert sim.stop_reason == "duration of 3.500000000 s"
        assert not sim.step()
        assert not sim.run_for(1)
        with pytest.raises(RunError, match=r"the run is over: duration of 3\.5"):
            sim.publish("numbers", _number(1))


def test_the_driver_can_end_the_run(simulate: Any) -> None:
    with simulate(GRAPH) as sim:
        sim.subscribe("/numbers", lambda message: sim.stop("goal reached", 5))
        sim.run_for(60)
        assert sim.now_ns == 11 * 10**9
    assert (sim.result.stop_reason, sim.result.exit_code) == ("goal reached", 5)


@pytest.mark.long
def test_a_graph_that_waits_for_the_outside_is_no_deadlock(simulate: Any) -> None:
    code = "nodes: [{node: nodes_under_test:Sleeper}]\n"
    with simulate(code) as sim:
        sim.run_for("0.4s")  # a callback is blocked in the middle of its sleep
        sim.publish("numbers", _number(3))
        sim.run_for("0.4s")
    assert sim.result.error is None


# -- listening -------------------------------------------------------------------------------------


def test_taps_keep_what_was_published(simulate: Any) -> None:
    with simulate(GRAPH) as sim:
        sim.step()
        tap = sim.subscribe("numbers", depth=2)
        heard: list[int] = []
        sim.subscribe("numbers", lambda message: heard.append(message.data))
        sim.run_for(3)
        assert tap.count == 3
        assert [message.data for message in tap] == [3, 4]
        assert tap.messages[0][0] == 13 * 10**9
        assert (tap.latest.data, tap.take().data, len(tap)) == (4, 3, 1)
        assert heard == [2, 3, 4]
        sim.unsubscribe(tap)
        assert sim.wait_for_message("/numbers").data == 5
        assert sim.wait_for_message("/numbers", timeout="0.5s") is None
        assert tap.count == 3


@pytest.mark.long
def test_who_listens_may_answer_at_once(simulate: Any) -> None:
    from std_msgs.msg import UInt64

    with simulate(TALK) as sim:

        def answer(message: UInt64) -> None:
            assert sim.publish("numbers", UInt64(data=message.data * 100)) == 1

        tap = sim.subscribe("numbers")
        sim.subscribe("echoed", lambda m: answer(m) if m.data < 100 else None)
        sim.step()
        assert [message.data for message in tap] == [1, 100]
        assert sim.node("echo").heard == [(10**9, 1), (10**9, 100)]

        sim.subscribe("echoed", lambda message: sim.step())
        with pytest.raises(RunError, match="callback of subscribe cannot move time"):
            sim.step()


# -- doing things ----------------------------------------------------------------------------------


def test_what_is_published_from_outside_is_told_apart(simulate: Any, tmp_path: Path) -> None:
    with simulate("nodes: [{node: nodes_under_test:Echo}]\n", tmp_path / "t.mcap") as sim:
        sim.run_for("1.5s")
        assert sim.publish("/numbers", _number(4)) == 1
        assert sim.publish("/nobody", _number(4)) == 0
        sim.run_for(1)
        assert sim.call(sim.node("echo").say, 7) == "said"
        digest = sim.digest
    assert digest != sim.result.digest  # the nodes' end comes after
    with Trace.open(tmp_path / "t.mcap") as trace:
        events = [trace.event(i) for i in range(trace.event_count)]
        outside = [event for event in events if event.kind is EventKind.OUTSIDE]
        assert {event.cause_event for event in outside} == {NO_EVENT}
        entities = trace.entities
        names = [entities[event.entity].name for event in outside if event.entity]
        assert names == ["/numbers", "/nobody"]
        assert [event.stamp_ns for event in outside][-1] == 2_500_000_000
        (heard,) = [event for event in events if event.kind is EventKind.SUBSCRIPTION]
        assert (heard.stamp_ns, events[heard.cause_event].kind) == (
            1_500_000_000,
            EventKind.OUTSIDE,
        )


def test_the_same_driver_gives_the_same_trace(simulate: Any, tmp_path: Path) -> None:
    def go(name: str) -> RunResult:
        jobs = "nodes: [{node: nodes_under_test:Sleeper}, {node: nodes_under_test:Echo}]\n"
        with simulate(jobs, tmp_path / name) as sim:
            for number in range(5):
                sim.publish("numbers", _number(number))
                sim.run_for("0.15s")
                sim.call(sim.node("echo").say, number)
        result = sim.result
        assert isinstance(result, RunResult)
        return result

    assert go("a.mcap").digest == go("b.mcap").digest
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("second", "said"),
    [
        (
            lambda sim: sim.publish("numbers", _number(5)),
            "the message from outside on /numbers at 1.0 s is different",
        ),
        (
            lambda sim: sim.call(sim.node("echo").say, 5),  # of two at one time, by their names
            "what outside did at 1.0 s is only in b; the next event in a is the message from "
            "outside on /numbers at 1.0 s",
        ),
        (lambda sim: None, "the message from outside on /numbers at 1.0 s is only in a"),
    ],
)
def test_a_diff_blames_the_driver(simulate: Any, tmp_path: Path, second: Any, said: str) -> None:
    def go(name: str, act: Callable[[Simulation], object]) -> Path:
        with simulate(TALK, tmp_path / name) as sim:
            sim.publish("numbers", _number(1))
            sim.run_for(1)
            act(sim)
            sim.run_for(1)
        return tmp_path / name

    difference = rsltrace.diff(
        go("a.mcap", lambda sim: sim.publish("numbers", _number(4))), go("b.mcap", second)
    )
    assert said.lower() in difference.sentence.lower()


def test_what_is_done_to_a_node_directly_is_an_event_from_outside(
    simulate: Any, tmp_path: Path
) -> None:
    with simulate("nodes: [{node: nodes_under_test:Echo}]\n", tmp_path / "t.mcap") as sim:
        sim.run_for(1)
        sim.node("echo").say(3)  # not through call
        sim.run_for(1)
    with Trace.open(tmp_path / "t.mcap") as trace:
        events = [trace.event(i) for i in range(trace.event_count)]
        (event,) = [event for event in events if event.kind is EventKind.OUTSIDE]
        assert (event.stamp_ns, event.outputs) == (10**9, 1)


@pytest.mark.long
def test_a_call_from_outside_can_wait(simulate: Any) -> None:
    from std_srvs.srv import Trigger

    with simulate("nodes: [{node: nodes_under_test:Server}]\n") as sim:
        client = sim.call(sim.node("server").create_client, Trigger, "trigger")
        answer = sim.call(client.call, Trigger.Request())
        assert (answer.message, sim.now_ns) == ("done", 2 * 10**9)
        lonely = sim.call(sim.node("server").create_client, Trigger, "nobody")
        with pytest.raises(DeadlockError, match=r"/nobody|response to a service call"):
            sim.call(lonely.call, Trigger.Request())
        with pytest.raises(ZeroDivisionError):
            sim.call(lambda: 1 / 0)
        with pytest.raises(UnsupportedError, match=r"use sim\.call"):
            client.call(Trigger.Request())
        assert not sim.done


# -- what goes wrong -------------------------------------------------------------------------------


@pytest.mark.long
def test_a_node_that_raises_raises_in_the_step(simulate: Any, tmp_path: Path) -> None:
    with simulate("nodes: [{node: nodes_under_test:Echo}]\n", tmp_path / "t.mcap") as sim:
        sim.publish("numbers", _number(13))
        with pytest.raises(NodeError, match="raised ValueError: thirteen") as info:
            sim.run_for(1)
        assert isinstance(info.value.__cause__, ValueError)
        assert sim.done
        assert not sim.run_for(1)
    assert sim.result.exit_code == 3
    assert sim.result.error is info.value
    with Trace.open(tmp_path / "t.mcap") as trace:
        assert trace.complete


def fail_after_3_s(sim: Simulation) -> None:
    sim.run_for(3)
    raise LookupError("mine")


def test_an_error_of_the_driver_closes_the_trace(simulate: Any, tmp_path: Path) -> None:
    sim = simulate(GRAPH, tmp_path / "t.mcap")
    with pytest.raises(LookupError, match="mine"), sim:
        fail_after_3_s(sim)
    assert sim.result.stop_reason == "the driver of the simulation raised LookupError"
    assert sim.result.exit_code == 1
    with Trace.open(tmp_path / "t.mcap") as trace:
        assert trace.complete
        assert trace.digest == sim.result.digest


@pytest.mark.long
def test_a_constructor_that_raises(job_file: Any) -> None:
    broken = "class Broken(Node):\n    def __init__(self):\n        raise OSError('no device')\n"
    job = job_file("nodes: [{node: nodes_under_test:Broken}]\n", broken)
    sim = Simulation(job)
    with pytest.raises(NodeError, match="raised OSError: no device"), sim:
        raise AssertionError("never entered")
    assert sim.result.exit_code == 3


def test_clear_errors(simulate: Any, tmp_path: Path) -> None:
    from std_msgs.msg import String

    sim = simulate(GRAPH, tmp_path / "t.mcap")
    with pytest.raises(RunError, match="enter the simulation first"):
        sim.step()
    with pytest.raises(RunError, match="when its block has been left"):
        _ = sim.result
    with sim:
        with pytest.raises(RunError, match="no node named lisener; did you mean '/listener'"):
            sim.node("lisener")
        with pytest.raises(RunError, match="/numbers carries std_msgs/msg/UInt64, not std_msgs"):
            sim.publish("/numbers", String(data="x"))
        with pytest.raises(RunError, match="is not a topic"):
            sim.publish("/a b", String(data="x"))
        failures: list[Exception] = []

        def from_thread() -> None:
            try:
                sim.step()
            except RunError as error:
                failures.append(error)

        thread = threading.Thread(target=from_thread)
        thread.start()
        thread.join()
        assert "the thread that has entered it" in str(failures[0])
    with pytest.raises(RunError, match="only within the block"):
        sim.node("talker")
    with pytest.raises(RunError, match="entered once"), sim:
        pass
    with pytest.raises(OutputError, match="it exists"), simulate(GRAPH, tmp_path / "t.mcap"):
        pass


@pytest.mark.long
def test_a_node_cannot_drive_its_own_simulation(job_file: Any) -> None:
    from rclpy.node import Node

    class Greedy(Node):
        def __init__(self) -> None:
            super().__init__("greedy")
            self.create_timer(1.0, lambda: simulations[0].step())

    job = Job(nodes=[NodeSpec(node=Greedy)])
    simulations = [Simulation(job)]
    with simulations[0] as sim, pytest.raises(RunError, match="part of"):
        sim.run_for(2)


def test_one_simulation_at_a_time(simulate: Any, tmp_path: Path) -> None:
    with simulate(GRAPH) as sim:
        sim.step()
        with pytest.raises(UnsupportedError, match="another simulation is running"):
            simulate(GRAPH, tmp_path / "t.mcap").__enter__()
        with pytest.raises(UnsupportedError, match="another simulation is running"):
            rsltrace.record(sim._session.job, None)
        assert sim.run_for(2)
        assert sim.node("talker").count == 3
    assert not (tmp_path / "t.mcap").exists()


def test_simulations_one_after_the_other_do_not_disturb_each_other(simulate: Any) -> None:
    digests = []
    for _ in range(2):
        with simulate(GRAPH) as sim:
            sim.run_for(3)
            digests.append((sim.events, sim.node("listener").total))
    assert digests[0] == digests[1]


def test_nodes_of_mains_and_their_end(job_file: Any, tmp_path: Path) -> None:
    job = job_file(MAINS, MORE + MAIN)
    with Simulation(job, tmp_path / "t.mcap") as sim:
        sim.run_for("2.5s")
        assert [value for _, value in sim.node("echo").heard] == [1, 2]
        sim.publish("numbers", _number(100))
        sim.run_for("0.1s")
        assert [value for _, value in sim.node("echo").heard] == [1, 2, 100]
        assert sim.call(sim.node("echo").say, 5) == "said"
    with Trace.open(tmp_path / "t.mcap") as trace:
        logs = [trace.decode("/rosout", data) for _, _, data in trace.messages("/rosout")]
    assert "goodbye" in [log.msg for log in logs]  # type: ignore[attr-defined]
