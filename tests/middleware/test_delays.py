"""Delay models in runs: when messages arrive, what is lost, what the trace says of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("rclpy")

from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

from rsltrace.trace.model.event import EventKind, OutputKind, decision_text

pytestmark = pytest.mark.ros

MS = 1_000_000
BEST_EFFORT = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.BEST_EFFORT)


class Talker(Node):  # type: ignore[misc]
    def __init__(self, qos: Any = 10, period: float = 0.1, topic: str = "numbers") -> None:
        super().__init__("talker")
        self.publisher = self.create_publisher(UInt64, topic, qos)
        self.count = 0
        self.create_timer(period, self.tick)

    def tick(self) -> None:
        self.count += 1
        self.publisher.publish(UInt64(data=self.count))


class Listener(Node):  # type: ignore[misc]
    def __init__(self, name: str = "listener", qos: Any = 10, topic: str = "numbers") -> None:
        super().__init__(name)
        self.heard: list[tuple[int, int]] = []
        self.lost = 0
        from rclpy.event_handler import SubscriptionEventCallbacks

        events = SubscriptionEventCallbacks(message_lost=self.on_lost)
        self.create_subscription(UInt64, topic, self.got, qos, event_callbacks=events)

    def got(self, message: UInt64) -> None:
        self.heard.append((message.data, self.get_clock().now().nanoseconds // MS))

    def on_lost(self, status: Any) -> None:
        self.lost += status.total_count_change


class Run:
    """A recorded run, with the listeners it had."""

    def __init__(self, simulate: Callable[..., Any]) -> None:
        self._simulate = simulate
        self.nodes: dict[str, Any] = {}

    def __call__(self, *makers: Callable[[], Node], delay: Any, **options: Any) -> Any:
        def all_of_them() -> list[Node]:
            nodes = [make() for make in makers]
            self.nodes = {node.get_name(): node for node in nodes}
            return nodes

        duration = options.pop("duration", 1.0)
        return self._simulate(all_of_them, duration=duration, job={"delay": delay, **options})

    @property
    def heard(self) -> list[tuple[int, int]]:
        heard: list[tuple[int, int]] = self.nodes["listener"].heard
        return heard


@pytest.fixture
def run(simulate: Callable[..., Any]) -> Run:
    return Run(simulate)


def test_a_constant_delay_moves_arrivals_and_nothing_else(run: Run) -> None:
    run(Talker, Listener, delay={"topics": {"/numbers": "30ms"}}, duration=0.35)
    assert run.heard == [(1, 130), (2, 230), (3, 330)]


def test_links_of_one_topic_may_differ(run: Run) -> None:
    delay = {
        "default": "5ms",
        "links": [{"topic": "/numbers", "to": "/far", "constant": "70ms"}],
    }
    run(Talker, Listener, lambda: Listener("far"), delay=delay, duration=0.18)
    assert run.heard == [(1, 105)]
    assert run.nodes["far"].heard == [(1, 170)]


def test_each_delay_is_in_the_trace_and_is_the_one_that_happened(run: Run) -> None:
    recorded = run(Talker, Listener, delay={"default": {"uniform": {"min": "1ms", "max": "90ms"}}})
    with recorded.trace() as trace:
        events = [trace.event(i) for i in range(trace.event_count)]
        sent = {e.index: trace.outputs_of(e.index) for e in events if e.kind is EventKind.TIMER}
        checked = 0
        for event in events:
            if event.kind is EventKind.SUBSCRIPTION:
                (draw,) = (o for o in sent[event.cause_event] if o.kind is OutputKind.DRAW)
                took_ns = event.stamp_ns - events[event.cause_event].stamp_ns
                assert draw.hash & (2**56 - 1) == took_ns
                assert draw.entity == event.entity
                assert decision_text(draw.hash).startswith("delay ")
                checked += 1
    assert checked >= 8


@pytest.mark.long
def test_the_seed_decides_and_another_topic_changes_nothing(run: Run) -> None:
    delay = {"default": {"normal": {"mean": "30ms", "sd": "10ms"}}}
    run(Talker, Listener, delay=delay)
    first = run.heard
    run(Talker, Listener, delay=delay)
    assert run.heard == first
    run(Talker, Listener, delay=delay, seed=1)
    assert run.heard != first

    def noisy() -> Node:
        node = Node("noisy")
        node.p = node.create_publisher(UInt64, "noise", 10)
        node.create_subscription(UInt64, "noise", lambda m: None, 10)
        node.create_timer(0.01, lambda: node.p.publish(UInt64()))
        return node

    run(noisy, Talker, Listener, delay=delay)
    assert run.heard == first


def test_best_effort_loses_and_is_told_so(run: Run) -> None:
    makers = (lambda: Talker(BEST_EFFORT, 0.01), lambda: Listener(qos=BEST_EFFORT))
    recorded = run(*makers, delay={"topics": {"/numbers": {"drop": 0.3}}})
    heard = [number for number, _ in run.heard]
    assert 50 < len(heard) < 90
    assert run.nodes["listener"].lost == heard[-1] - len(heard)
    with recorded.trace() as trace:
        texts = [
            decision_text(output.hash)
            for i in range(trace.event_count)
            for output in trace.outputs_of(i)
            if output.kind is OutputKind.DRAW
        ]
    assert texts.count("lost") == 100 - len(heard)


def test_reliable_loses_nothing_but_time(run: Run) -> None:
    delay = {"topics": {"/numbers": {"constant": "1ms", "drop": 0.3, "retransmit": "7ms"}}}
    run(lambda: Talker(10, 0.05), Listener, delay=delay)
    assert [number for number, _ in run.heard] == list(range(1, len(run.heard) + 1))
    late = [(at - number * 50 - 1) / 7 for number, at in run.heard]
    assert {0.0, 1.0} <= set(late)
    assert all(extra == int(extra) for extra in late)


def test_a_best_effort_subscription_of_a_reliable_publisher_is_best_effort(run: Run) -> None:
    delay = {"topics": {"/numbers": {"drop": 1.0}}}
    run(Talker, lambda: Listener(qos=BEST_EFFORT), delay=delay)
    assert run.heard == []


def test_duplicates_arrive_twice(run: Run) -> None:
    delay = {"topics": {"/numbers": {"constant": "5ms", "duplicate": 1.0}}}
    run(Talker, Listener, delay=delay, duration=0.25)
    assert run.heard == [(1, 105), (1, 105), (2, 205), (2, 205)]


def test_a_copy_of_what_an_outage_pushed_out_does_not_arrive_either(run: Run) -> None:
    delay = {
        "default": {"duplicate": 1.0},
        "outages": [{"node": "/talker", "from": "0.25s", "to": "0.65s"}],
    }
    run(lambda: Talker(2), Listener, delay=delay, duration=0.75)
    assert [number for number, _ in run.heard] == [1, 1, 2, 2, 5, 5, 6, 6, 7, 7]


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "model",
    [
        {"lognormal": {"median": "1h", "sigma": 10}},
        {"gamma": {"shape": 1e9, "scale": "10000h"}},
        {"normal": {"mean": "2500000h", "sd": "2500000h"}},
    ],
)
def test_the_longest_tail_is_a_delay_and_nothing_else(run: Run, model: dict[str, Any]) -> None:
    # A delay of more than 56 bits once ran over into what the draw is.
    recorded = run(Talker, Listener, delay={"default": model}, duration=3.0)
    assert run.nodes["talker"].count == 30
    with recorded.trace() as trace:
        outputs = [out for i in range(trace.event_count) for out in trace.outputs_of(i)]
    said = [decision_text(out.hash) for out in outputs if out.kind is OutputKind.DRAW]
    assert {text.split()[0] for text in said} == {"delay"}
    assert len(said) == 30


@pytest.mark.long
def test_an_outage_of_a_node_cuts_topics_and_holds_what_is_reliable(run: Run) -> None:
    delay = {"outages": [{"node": "/talker", "from": "0.25s", "to": "0.65s"}]}
    run(lambda: Talker(2), Listener, delay=delay, start="100s", duration=0.85)
    # Numbers 3 to 6 are sent during the outage; a history of 2 keeps the last two of them.
    since = [(number, at - 100_000) for number, at in run.heard]
    assert since == [(1, 100), (2, 200), (5, 650), (6, 650), (7, 700), (8, 800)]
    assert run.nodes["listener"].lost == 2
    run(
        lambda: Talker(BEST_EFFORT),
        lambda: Listener(qos=BEST_EFFORT),
        delay={"outages": [{"topic": "/num*", "from": "0.25s", "to": "0.65s"}]},
    )
    assert [number for number, _ in run.heard] == [1, 2, 7, 8, 9, 10]


def test_a_link_that_gets_worse(run: Run) -> None:
    delay = {"topics": {"/numbers": {"series": {"points": [["0s", "0s"], ["1s", "100ms"]]}}}}
    run(Talker, Listener, delay=delay)
    assert run.heard == [(n, n * 100 + n * 10) for n in range(1, 10)]


def test_late_joiners_get_their_history_over_the_link(run: Run) -> None:
    latched = QoSProfile(depth=5, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)

    def early() -> Node:
        node = Node("early")
        node.create_publisher(UInt64, "numbers", latched).publish(UInt64(data=9))
        return node

    run(early, lambda: Listener(qos=latched), delay={"default": "40ms"}, duration=0.1)
    assert run.heard == [(9, 40)]


def test_services_take_their_time_both_ways(run: Run) -> None:
    answers: list[tuple[str, int]] = []

    def server() -> Node:
        node = Node("server")

        def serve(request: Any, response: Any) -> Any:
            response.message = str(node.get_clock().now().nanoseconds // MS)
            return response

        node.create_service(Trigger, "ask", serve)
        return node

    def client() -> Node:
        node = Node("client")
        asker = node.create_client(Trigger, "ask")

        def ask() -> None:
            timer.cancel()
            asker.call_async(Trigger.Request()).add_done_callback(
                lambda future: answers.append(
                    (future.result().message, node.get_clock().now().nanoseconds // MS)
                )
            )

        timer = node.create_timer(0.1, ask)
        return node

    run(server, client, delay={"services": {"/ask": {"constant": "20ms"}}})
    assert answers == [("120", 140)]
    outage = {"service": "/ask", "from": "0s", "to": "0.3s"}
    run(server, client, delay={"default": "20ms", "outages": [outage]})
    assert answers[1:] == [("320", 340)]


@pytest.mark.long
def test_messages_under_way_survive_their_publisher_but_not_their_subscription(run: Run) -> None:
    class Leaver(Talker):
        def tick(self) -> None:
            super().tick()
            self.destroy_publisher(self.publisher)
            self.destroy_timer(next(iter(self.timers)))

    run(Leaver, Listener, delay={"default": "30ms"})
    assert run.heard == [(1, 130)]

    class Deaf(Listener):
        def __init__(self) -> None:
            super().__init__()
            self.create_timer(0.11, self.stop)

        def stop(self) -> None:
            for subscription in list(self.subscriptions):
                self.destroy_subscription(subscription)

    run(Talker, Deaf, delay={"default": "30ms"})
    assert run.heard == []


@pytest.mark.long
@pytest.mark.parametrize("loss", [0.0, 1e-9])  # a link that may lose messages has more to do
def test_what_arrives_at_one_instant_arrives_in_the_order_of_sending(
    run: Run, simulate: Callable[..., Any], tmp_path: Any, loss: float
) -> None:
    """A bag's message comes before everything else that is due, so it could overtake."""
    run(Talker, delay=None, duration=0.25).path.rename(tmp_path / "bag.mcap")
    series = {"points": [["0s", "100ms"], ["0.1s", "0s"]], "steps": True}
    ears: list[Any] = []

    def listener() -> Node:
        ears.append(Listener())
        return ears[-1]

    delay = {"topics": {"/numbers": {"series": series, "drop": loss}}}
    simulate(
        listener,
        duration=0.3,
        job={"bags": [{"path": "bag.mcap", "topics": ["/numbers"]}], "delay": delay},
    )
    assert ears[0].heard == [(1, 200), (2, 200)]


@pytest.mark.long
def test_what_chance_decided_is_said_in_words(run: Run) -> None:
    from rsltrace.trace.words.events import EventWords

    recorded = run(Talker, Listener, delay={"default": "5ms"}, duration=0.1)
    with recorded.trace() as trace:
        event = next(e for e in recorded.events() if e.kind is EventKind.TIMER)
        outputs = trace.outputs_of(event.index)
        assert [o.kind for o in outputs] == [OutputKind.MESSAGE, OutputKind.DRAW]
        told = list(EventWords(trace).outputs(outputs))
        assert told == ["/numbers", "delay 5 ms (/listener)"]
