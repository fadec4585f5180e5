"""Faults of a job: single messages that go wrong, and nodes that crash, hang or start again."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

from rsltrace import Job, NodeSpec, StopSpec, diff, record
from rsltrace.errors import DeadlockError, JobError
from rsltrace.trace.model.event import EventKind

MS = 1_000_000
PERIOD_MS = 100


class Talker(Node):
    def __init__(self) -> None:
        super().__init__("talker")
        self.count = 0
        self.publisher = self.create_publisher(Int32, "/count", 10)
        self.create_timer(PERIOD_MS / 1000, self.tick)

    def tick(self) -> None:
        self.count += 1
        self.publisher.publish(Int32(data=self.count))


class Listener(Node):
    heard: list[tuple[int, int]]
    made = 0

    def __init__(self, name: str = "listener") -> None:
        super().__init__(name)
        Listener.made += 1
        self.mine: list[int] = []
        self.create_subscription(Int32, "/count", self.hear, 3)

    def hear(self, message: Any) -> None:
        self.mine.append(message.data)
        now_ms = self.get_clock().now().nanoseconds // MS
        type(self).heard.append((now_ms, message.data))
        self.get_logger().info(f"{message.data} of {len(self.mine)}")


class Second(Listener):
    def __init__(self) -> None:
        super().__init__("second")


@pytest.fixture(autouse=True)
def nobody_has_heard() -> None:
    for kind in (Listener, Second):
        kind.heard = []
    Listener.made = 0


def run(
    *nodes: Any, faults: list[dict[str, Any]], duration: float = 0.65, **more: Any
) -> list[tuple[int, int]]:
    Listener.heard, Second.heard = [], []
    specs = [node if isinstance(node, NodeSpec) else NodeSpec(node=node) for node in nodes]
    record(Job(nodes=specs, faults=faults, stop=StopSpec(duration=duration), **more), None)
    return Listener.heard


def on_time(*numbers: int) -> list[tuple[int, int]]:
    return [(PERIOD_MS * number, number) for number in numbers]


# -- messages ------------------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize("delay", [None, {"default": "0s"}])
def test_a_message_is_lost_late_or_comes_twice(delay: Any) -> None:
    def heard(*faults: dict[str, Any]) -> list[tuple[int, int]]:
        return run(Talker, Listener, faults=list(faults), delay=delay)

    assert heard({"drop": "/count", "message": 3}) == on_time(1, 2, 4, 5, 6)
    late = heard({"delay": "/count", "message": 2, "by": "250ms"})
    assert late == [*on_time(1), (450, 2), (450, 3), (450, 4), *on_time(5, 6)]
    twice = heard({"duplicate": "/count", "message": 2, "by": "30ms"})
    assert twice == [*on_time(1, 2), (230, 2), *on_time(3, 4, 5, 6)]
    at_once = heard({"duplicate": "/count", "message": 6})
    assert at_once == [*on_time(1, 2, 3, 4, 5, 6), (600, 6)]


def test_a_fault_of_one_receiver_leaves_the_others_alone() -> None:
    heard = run(Talker, Listener, Second, faults=[{"drop": "/count", "message": 2, "to": "/sec*"}])
    assert heard == on_time(1, 2, 3, 4, 5, 6)
    assert Second.heard == on_time(1, 3, 4, 5, 6)


def test_messages_of_a_topic_are_counted_whoever_sends_them() -> None:
    specs = [NodeSpec(node=Talker, name=name) for name in ("one", "two")]
    heard = run(*specs, Listener, faults=[{"drop": "/count", "message": 4}], duration=0.25)
    assert heard == [(100, 1), (100, 1), (200, 2)]


# -- nodes ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_run_with_faults_follows_its_own_recorded_order_and_a_diff_names_the_fault(
    simulate: Callable[..., Any], tmp_path: Path
) -> None:
    faults = [{"hang": "/listener", "event": 12, "for_ns": 200 * MS}]
    options = {"faults": faults, "policy": "permutation", "seed": 3}
    first = simulate(Talker, Listener, duration=0.65, job=options)
    kept = first.path.rename(tmp_path / "first.mcap")
    again = simulate(
        Talker, Listener, duration=0.65, job={**options, "policy": {"recorded": str(kept)}}
    )
    assert again.result.digest == first.result.digest
    plain = simulate(Talker, Listener, duration=0.65, job={**options, "faults": []})
    found = diff(kept, plain.path)
    assert "the fault of /listener" in found.sentence
    assert "faults" in found.divergences[0].root_sentence


@pytest.mark.long
def test_a_node_that_crashes_is_gone_and_everything_before_it_is_as_without(
    simulate: Callable[..., Any],
) -> None:
    seen: list[int] = []

    def watcher() -> Node:
        node = Node("watcher")
        node.create_timer(0.1, lambda: seen.append(node.count_publishers("/count")))
        return node

    plain = simulate(Talker, Listener, watcher, duration=0.65).events()
    seen.clear()
    faults = [{"crash": "/talker", "at": "350ms"}]
    run = simulate(Talker, Listener, watcher, duration=0.65, job={"faults": faults})
    assert Listener.heard[-3:] == on_time(1, 2, 3)
    assert seen == [1, 1, 1, 0, 0, 0]
    events = run.events()
    (struck,) = [event for event in events if event.kind is EventKind.FAULT]
    assert struck.stamp_ns == 350 * MS
    assert events[: struck.index] == plain[: struck.index]
    with run.trace() as trace:
        assert trace.entity(struck.entity).name == "/talker"


@pytest.mark.few(3)
@pytest.mark.parametrize("number", [0, 13, 900])
def test_a_fault_strikes_right_after_the_event_with_its_number(
    simulate: Callable[..., Any], number: int
) -> None:
    faults = [{"hang": "/listener", "event": number}]
    run = simulate(Talker, Listener, duration=0.65, job={"faults": faults})
    struck = [event.index for event in run.events() if event.kind is EventKind.FAULT]
    # While nodes are made it is too early: then it is the first event after that.
    assert struck == {0: [2], 13: [14], 900: []}[number]
    assert any("did not happen" in note for note in run.result.notes) == (not struck)


def test_a_node_that_hangs_finds_its_queue_and_a_late_timer_afterwards() -> None:
    ticks: list[int] = []

    class Ticking(Listener):
        def __init__(self) -> None:
            super().__init__("ticking")
            self.create_timer(0.2, lambda: ticks.append(self.get_clock().now().nanoseconds // MS))

    Ticking.heard = []
    hang = {"hang": "/ticking", "at": "150ms", "for": "500ms"}
    run(Talker, Ticking, faults=[hang], duration=0.9)
    assert Ticking.heard == [*on_time(1), (650, 4), (650, 5), (650, 6), *on_time(7, 8, 9)]
    assert ticks == [650, 800]


@pytest.mark.long
def test_calls_and_coroutines_of_a_node_that_hangs_go_on_with_it() -> None:
    done: list[tuple[str, int]] = []

    class Sleeper(Node):
        def __init__(self) -> None:
            super().__init__("sleeper")
            self.create_timer(1.0, self.sleep)
            self.client = self.create_client(Trigger, "/slow")
            self.create_timer(1.0, self.ask, callback_group=ReentrantCallbackGroup())

        def note(self, what: str) -> None:
            done.append((what, self.get_clock().now().nanoseconds // MS))

        def sleep(self) -> None:
            time.sleep(0.1)
            self.note("slept")

        async def ask(self) -> None:
            await self.client.call_async(Trigger.Request())
            self.note("asked")

    def server() -> Node:
        node = Node("server")

        def serve(request: Any, response: Any) -> Any:
            time.sleep(0.2)
            return response

        node.create_service(Trigger, "/slow", serve)
        return node

    run(server, Sleeper, faults=[], duration=1.9)
    assert done == [("slept", 1100), ("asked", 1200)]
    done.clear()
    run(
        server, Sleeper, faults=[{"hang": "/sleeper", "at": "1050ms", "for": "400ms"}], duration=1.9
    )
    assert done == [("slept", 1450), ("asked", 1450)]
    done.clear()
    run(server, Sleeper, faults=[{"crash": "/sleeper", "at": "1050ms"}], duration=1.9)
    run(server, Sleeper, faults=[{"hang": "/sleeper", "at": "1050ms"}], duration=1.9)
    assert done == []


@pytest.mark.long
def test_who_waits_for_a_node_that_is_gone_waits_for_ever() -> None:
    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            self.client = self.create_client(
                Trigger, "/answer", callback_group=ReentrantCallbackGroup()
            )
            self.timer = self.create_timer(0.2, self.ask)

        def ask(self) -> None:
            self.timer.cancel()
            self.client.call(Trigger.Request())

    def server() -> Node:
        node = Node("server")
        node.create_service(Trigger, "/answer", lambda request, response: response)
        return node

    run(server, Asker, faults=[], duration=1.0)
    for kind in ("crash", "hang"):
        with pytest.raises(DeadlockError, match="/asker: timer"):
            record(
                Job(
                    nodes=[NodeSpec(node=server), NodeSpec(node=Asker)],
                    faults=[{kind: "/server", "at": "0.1s"}],
                ),
                None,
            )


def test_a_node_that_starts_again_begins_anew() -> None:
    heard = run(
        Talker,
        Listener,
        faults=[{"restart": "/talker", "topic": "/count", "message": 2, "for": "150ms"}],
        duration=0.75,
    )
    assert heard == [*on_time(1, 2), (450, 1), (550, 2), (650, 3), (750, 4)]
    heard = run(Talker, Listener, faults=[{"restart": "/listener", "at": "250ms"}])
    assert heard == on_time(1, 2, 3, 4, 5, 6)
    assert Listener.made == 3


def test_one_process_has_all_nodes_of_its_entry() -> None:
    def both() -> list[Node]:
        return [Talker(), Second()]

    heard = run(both, Listener, faults=[{"crash": "/second", "at": "250ms"}])
    assert heard == on_time(1, 2)


# -- mains ---------------------------------------------------------------------------------------


@pytest.mark.long
def test_mains_crash_hang_and_start_again() -> None:
    ends: list[str] = []

    def main() -> None:
        rclpy.init()
        try:
            rclpy.spin(Talker())
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        finally:
            ends.append("finally")

    globals()["_main"] = main
    talker = NodeSpec(main=f"{__name__}:_main")

    def heard(**fault: Any) -> list[tuple[int, int]]:
        ends.clear()
        return run(talker, Listener, faults=[fault], search_path=["."])

    assert heard(crash="/talker", at="250ms") == on_time(1, 2)
    assert ends == []
    assert heard(hang="/talker", at="250ms") == on_time(1, 2)
    held = heard(hang="/talker", at="250ms", for_ns=300 * MS)
    assert held == [*on_time(1, 2), (550, 3), (600, 4)]
    assert ends == ["finally"]
    again = heard(restart="/talker", at="250ms", for_ns=100 * MS)
    assert again == [*on_time(1, 2), (450, 1), (550, 2), (650, 3)]
    assert ends == ["finally"]  # of the second one
    assert heard(crash="/listener", at="350ms") == on_time(1, 2, 3)


# -- what is wrong with a job --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({}, "none is given"),
        ({"crash": "/a", "hang": "/a", "at": 1}, "crash and hang are given"),
        ({"crash": "/a"}, "when\\? Give at: 2s"),
        ({"crash": "/a", "at": 1, "event": 2}, "at and event are given"),
        ({"crash": "/a", "topic": "/t"}, "give message: 3"),
        ({"crash": "/a", "message": 3}, "give topic: /goal"),
        ({"crash": "/a", "at": 1, "by": 1}, "by is for duplicate and delay, not for crash"),
        ({"crash": "/a", "at": 1, "for_ns": 1}, "for is for hang and restart, not for crash"),
        ({"drop": "/t"}, "which message of /t"),
        ({"drop": "/t", "message": 1, "at": 2}, "at is for crash and hang and restart"),
        ({"delay": "/t", "message": 1}, "how late is the message"),
        ({"drop": "/t", "message": 0}, "must be at least 1"),
        ({"drop": "t", "message": 1}, "write '/t'"),
        ({"change": "/t", "message": 1}, "what changes\\? Give field"),
        ({"change": "/t", "message": 1, "field": "x"}, "give one of value, .*: none is given"),
        ({"change": "/t", "message": 1, "field": "x", "value": 1, "scale": 2}, "value and scale"),
        ({"change": "/t", "message": 1, "field": "x[", "value": 1}, "'x\\[' is not a field"),
        ({"change": "/t", "message": 1, "field": "x", "value": {}}, "expected text, a number"),
        ({"change": "/t", "message": 1, "field": "x", "scale": float("inf")}, "must be at least"),
        ({"swap": "/t", "message": 1, "field": "x"}, "field is for change, not for swap"),
        ({"repeat": "/t", "message": 1}, "no message before the first"),
        ({"swap": "/t", "message": 1, "to": "/n"}, "to is for drop and duplicate and delay"),
    ],
)
def test_a_fault_that_makes_no_sense_is_refused(fault: dict[str, Any], said: str) -> None:
    with pytest.raises(JobError, match=said):
        Job(nodes=[NodeSpec(node=Talker)], faults=[fault])


def test_what_cannot_happen_is_told() -> None:
    def result(*faults: dict[str, Any]) -> Any:
        nodes = [NodeSpec(node=Talker), NodeSpec(node=Listener)]
        return record(Job(nodes=nodes, faults=faults, stop=StopSpec(duration=0.35)), None)

    notes = "\n".join(
        result(
            {"crash": "/talkr", "at": "1ms"},
            {"crash": "/talker", "at": "5s"},
            {"drop": "/count", "message": 9},
        ).notes
    )
    assert "there was no node /talkr at 0.001000000 s" in notes
    assert "no node fits '/talkr'; did you mean '/talker'" in notes
    assert "faults[1]: this fault did not happen: the run ended before it" in notes
    assert "faults[2]: this fault did not happen: there were 3 messages on /count" in notes
    assert result({"drop": "/count", "message": 1}).notes == ()
