"""Policies on hand-computed schedules, and a recorded order followed exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

pytest.importorskip("rclpy")

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import String

from rsltrace.errors import JobError, RunError
from rsltrace.simulation.loop.policy import Candidate, ChoicePoint

pytestmark = pytest.mark.ros

ORDER: list[str] = []


class Periodic(Node):  # type: ignore[misc]
    """Timers that write down when they run: name -> period in ms."""

    def __init__(self, name: str, **timers: int) -> None:
        super().__init__(name)
        for timer, period_ms in timers.items():
            self.create_timer(period_ms / 1000, self._writer(timer))

    def _writer(self, timer: str) -> Callable[[], None]:
        def write() -> None:
            ORDER.append(timer)

        write.__qualname__ = timer
        return write


class Burst(Node):  # type: ignore[misc]
    """Publishes on topics a, b and c at once, and hears them in groups of its own."""

    def __init__(self) -> None:
        super().__init__("burst")
        self.mine = {t: self.create_publisher(String, t, 10) for t in "abc"}
        group = MutuallyExclusiveCallbackGroup()
        groups = {"a": None, "b": group, "c": group}
        for topic in "abc":
            self.create_subscription(
                String, topic, self._hear(topic), 10, callback_group=groups[topic]
            )
        self.create_timer(0.1, self.send)

    def send(self) -> None:
        for publisher in self.mine.values():
            publisher.publish(String())

    def _hear(self, topic: str) -> Callable[[Any], None]:
        return lambda message: ORDER.append(topic)


@pytest.fixture
def order(simulate: Callable[..., Any]) -> Callable[..., list[str]]:
    def run(*makers: Any, policy: Any, ms: int = 120, **job: Any) -> list[str]:
        ORDER.clear()
        simulate(*makers, duration=ms / 1000, job={"policy": policy, **job})
        return list(ORDER)

    return run


def test_rate_monotonic_runs_the_shortest_period_first(order: Any) -> None:
    """At 60 ms all three are due, at 40 and 80 ms the two fast ones; created slowest first."""

    def slow() -> Node:
        return Periodic("slow", s=60)

    def mixed() -> Node:
        return Periodic("mixed", m=40, f=20)

    makers = (slow, mixed)
    first_come = ["f", "m", "f", "s", "f", "m", "f", "f", "s", "m", "f"]
    assert order(*makers, policy="fifo") == first_come
    assert order(*makers, policy=None) == first_come
    by_rate = ["f", "f", "m", "f", "s", "f", "m", "f", "f", "m", "s"]
    assert order(*makers, policy="rate_monotonic") == by_rate


def listener(name: str, topic: str, period_ms: int = 0, then: str = "") -> Node:
    """Hears a topic; with a timer of its own, and a publisher that it answers on, if wanted."""
    node = Node(name)
    answer = node.create_publisher(String, then, 10) if then else None

    def hear(message: Any) -> None:
        ORDER.append(name)
        if answer is not None:
            answer.publish(message)

    node.create_subscription(String, topic, hear, 10)
    if period_ms:
        node.create_timer(period_ms / 1000, lambda: None)
    return node


def sender(name: str, topic: str, period_ms: int) -> Node:
    node = Node(name)
    publisher = node.create_publisher(String, topic, 10)
    node.create_timer(period_ms / 1000, lambda: publisher.publish(String()))
    return node


def test_subscriptions_have_the_rate_of_their_chain(order: Any) -> None:
    """The fast chain goes through two nodes, whatever timers they have; messages that come of no
    timer have the rate of their node."""
    makers = (
        lambda: sender("slow", "s", 40),
        lambda: sender("fast", "f", 20),
        lambda: listener("slow_end", "s", period_ms=5),
        lambda: listener("middle", "f", period_ms=500, then="g"),
        lambda: listener("fast_end", "g"),
    )
    at_once = {"execution": {"default": "1ms"}, "executors": "single_threaded"}
    fast, slow = ["middle", "fast_end"], ["slow_end"]
    found = order(*makers, policy="rate_monotonic", ms=66, **at_once)
    assert found == [*fast, *fast, *slow, *fast]
    assert order(*makers, policy="fifo", ms=66, **at_once) != found


def test_what_no_timer_has_caused_has_the_rate_of_its_node(order: Any) -> None:
    class Once(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("once")
            self.create_publisher(String, "a", 10).publish(String())

    makers = (lambda: listener("slow", "a", 500), lambda: listener("fast", "a", 90), Once)
    assert order(*makers, policy="fifo") == ["slow", "fast"]
    assert order(*makers, policy="rate_monotonic") == ["fast", "slow"]


@pytest.mark.long
def test_wait_sets_run_what_polling_points_find(order: Any) -> None:
    """/b is created before /a's second message comes: it waits for its polling point; timers of
    rclcpp do not, those of rclpy do."""

    class Polled(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("polled")
            self.mine = {topic: self.create_publisher(String, topic, 10) for topic in "abc"}
            for topic in "cba":
                self.create_subscription(String, topic, self.hear(topic), 10)
            self.create_timer(0.1, self.send)
            self.create_timer(0.105, lambda: ORDER.append("t"))

        def send(self) -> None:
            for topic in "ba":
                self.mine[topic].publish(String())

        def hear(self, topic: str) -> Callable[[Any], None]:
            def hear(message: Any) -> None:
                ORDER.append(topic)
                if topic == "b":
                    self.mine["c"].publish(String())

            return hear

    slow = {"execution": {"default": "4ms"}, "ms": 150}
    assert order(Polled, policy="fifo", **slow) == ["b", "a", "c", "t"]
    assert order(Polled, policy={"priority": [{"entity": "/c", "priority": 1}]}, **slow) == [
        *("b", "c", "a", "t")
    ]
    assert order(Polled, policy="wait_set", **slow) == ["b", "t", "a", "c"]
    assert order(Polled, policy="rclpy", **slow) == ["b", "a", "t", "c"]


@pytest.mark.few(8)
@pytest.mark.parametrize(
    ("rules", "expected"),
    [
        ([], ["a", "b", "c"]),
        ([{"priority": 1, "entity": "/c"}], ["c", "a", "b"]),
        ([{"priority": -1, "entity": "/a"}, {"priority": 5, "entity": "/c"}], ["c", "b", "a"]),
        ([{"priority": 7, "group_of": "/b"}], ["b", "c", "a"]),
        ([{"priority": 7, "group_of": "/b"}, {"priority": 9, "entity": "/b"}], ["b", "c", "a"]),
        ([{"priority": 9, "node": "/nobody"}, {"priority": 3, "entity": "/b"}], ["b", "a", "c"]),
    ],
)
def test_priorities_of_entities_and_groups(order: Any, rules: Any, expected: list[str]) -> None:
    assert order(Burst, policy={"priority": rules}) == expected


def test_priorities_of_nodes_decide_over_timers_too(order: Any) -> None:
    makers = (lambda: Periodic("low", l=100), lambda: Periodic("high", h=100))
    assert order(*makers, policy="fifo") == ["l", "h"]
    rules = [{"node": "/high", "priority": 1}]
    assert order(*makers, policy={"priority": rules}) == ["h", "l"]


@pytest.mark.long
def test_a_permutation_has_every_order_and_the_seed_decides(order: Any) -> None:
    seen = {tuple(order(Burst, policy="permutation", seed=seed)) for seed in range(12)}
    assert len(seen) == 6
    runs = [order(Burst, policy="permutation", seed=3, ms=2000) for _ in range(2)]
    assert runs[0] == runs[1]
    assert runs[0] != order(Burst, policy="permutation", seed=4, ms=2000)


class Backwards:
    """A policy of one's own: last come, first served."""

    def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
        assert all(candidate.node == "/burst" for candidate in ready)
        return len(ready) - 1


def test_a_policy_of_ones_own(order: Any) -> None:
    assert order(Burst, policy={"function": Backwards}) == ["c", "b", "a"]


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda: 5, "a int has no method choose"),
        (lambda: 1 / 0, "the policy cannot be made: ZeroDivisionError"),
    ],
)
def test_a_policy_that_is_none_is_refused(order: Any, function: Any, message: str) -> None:
    with pytest.raises(JobError, match=message):
        order(Burst, policy={"function": function})


def test_a_policy_that_answers_nonsense_ends_the_run_with_its_name(order: Any) -> None:
    class Wild:
        def choose(self, ready: Sequence[Candidate], moment: ChoicePoint) -> int:
            return 99

    with pytest.raises(RunError, match="Wild chose 99 of"):
        order(Burst, policy={"function": Wild})


# -- recorded order --------------------------------------------------------------------------------


def test_a_recorded_order_is_followed_exactly(simulate: Any, tmp_path: Any) -> None:
    def record(policy: Any, seed: int = 0) -> Any:
        recorded = simulate(Burst, duration=1.0, job={"policy": policy, "seed": seed})
        recorded.path.rename(tmp_path / f"{seed}.mcap")
        return recorded.result.digest

    digest = record("permutation", 9)
    assert record(None, 1) != digest
    assert record({"recorded": "9.mcap"}, 2) == digest


def test_an_order_that_cannot_be_followed_is_told(simulate: Any, tmp_path: Any) -> None:
    simulate(Burst, duration=0.35).path.rename(tmp_path / "one.mcap")

    def other() -> list[Node]:
        return [Burst(), Periodic("late", x=150)]

    with pytest.raises(RunError) as caught:
        simulate(other, duration=0.35, job={"policy": {"recorded": "one.mcap"}})
    assert "the recorded order of one.mcap cannot be followed: its event" in str(caught.value)
    with pytest.raises(JobError, match="there is no such file"):
        simulate(Burst, job={"policy": {"recorded": "gone.mcap"}})
    (tmp_path / "no.mcap").write_bytes(b"nothing")
    with pytest.raises(JobError, match=r"policy\.recorded"):
        simulate(Burst, job={"policy": {"recorded": "no.mcap"}})


def test_a_shorter_recording_leads_as_far_as_it_goes(simulate: Any, tmp_path: Any) -> None:
    recorded = simulate(Burst, duration=0.35, job={"policy": "permutation"})
    recorded.path.rename(tmp_path / "short.mcap")
    longer = simulate(Burst, duration=0.75, job={"policy": {"recorded": "short.mcap"}})
    assert longer.result.events > recorded.result.events


# -- time steps ------------------------------------------------------------------------------------


def test_a_least_time_step_gathers_what_is_due(simulate: Any) -> None:
    recorded = simulate(
        lambda: Periodic("p", a=10, b=7), duration=0.05, job={"min_time_step": "20ms"}
    )
    stamps = [e.stamp_ns // 1_000_000 for e in recorded.events() if e.kind.label == "timer"]
    assert stamps == [20, 20, 40, 40, 50, 50]
    assert recorded.result.end_ns == 50_000_000


@pytest.mark.long
def test_the_ordered_loop_keeps_the_order_of_the_plain_one(tmp_path: Any) -> None:
    """RSLCPP's network through the other loop, with more workers than it could ever use."""
    from pathlib import Path

    from rsltrace import load_job, record

    folder = Path(__file__).parents[2] / "examples" / "rslcpp_determinism"
    text = (folder / "job.yaml").read_text()
    digests = []
    for extra in ("", "executors: [{workers: 1000}]\n"):
        path = tmp_path / "job.yaml"
        path.write_text(f"search_path: ['{folder}']\n{text}\n{extra}")
        job = load_job(path)
        job = job.replace(stop=job.stop.replace(duration="15s", function=None, time=None))
        digests.append(record(job, tmp_path / "run.mcap", force=True).digest)
    assert digests[0] == digests[1]
