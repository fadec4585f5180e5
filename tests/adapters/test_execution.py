"""Execution times and simulated executors: queues fill, deadlines pass, workers are busy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("rclpy")

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

from rsltrace.errors import DeadlockError
from rsltrace.trace.model.event import OutputKind, decision_text

pytestmark = pytest.mark.ros

MS = 1_000_000
SEEN: list[tuple[str, int]] = []


def now_ms(node: Node) -> int:
    return int(node.get_clock().now().nanoseconds // MS)


class Camera(Node):  # type: ignore[misc]
    """Publishes 1, 2, … every so many ms."""

    def __init__(self, period_ms: int = 10, qos: Any = 10, **events: Any) -> None:
        super().__init__("camera")
        self.publisher = self.create_publisher(
            UInt64, "image", qos, event_callbacks=PublisherEventCallbacks(**events)
        )
        self.count = 0
        self.create_timer(period_ms / 1000, self.tick)

    def tick(self) -> None:
        self.count += 1
        self.publisher.publish(UInt64(data=self.count))


class Detector(Node):  # type: ignore[misc]
    """Hears images and publishes what it found in them."""

    def __init__(self, depth: int = 10, name: str = "detector", group: Any = None) -> None:
        super().__init__(name)
        self.publisher = self.create_publisher(UInt64, "found", 10)
        self.create_subscription(UInt64, "image", self.got, depth, callback_group=group)

    def got(self, message: UInt64) -> None:
        SEEN.append((f"{self.get_name()} {message.data}", now_ms(self)))
        self.publisher.publish(message)


class Planner(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("planner")
        self.create_subscription(UInt64, "found", self.got, 10)

    def got(self, message: UInt64) -> None:
        SEEN.append((f"planner {message.data}", now_ms(self)))


@pytest.fixture
def run(simulate: Callable[..., Any]) -> Callable[..., Any]:
    def go(*makers: Any, ms: int, **job: Any) -> Any:
        SEEN.clear()
        return simulate(*makers, duration=ms / 1000, job=job)

    return go


DETECTOR_25 = {"nodes": {"/detector": "25ms"}}


def test_events_start_when_their_node_is_free_and_send_when_it_is_done(run: Any) -> None:
    run(Camera, Detector, Planner, ms=100, execution=DETECTOR_25)
    # Images come every 10 ms; the detector takes 25: 10..35, 35..60, 60..85, 85..
    assert SEEN == [
        ("detector 1", 10),
        ("detector 2", 35),
        ("planner 1", 35),
        ("detector 3", 60),
        ("planner 2", 60),
        ("detector 4", 85),
        ("planner 3", 85),
    ]


def test_a_short_queue_drops_what_a_slow_node_cannot_take(run: Any) -> None:
    run(Camera, lambda: Detector(1), ms=100, execution=DETECTOR_25)
    assert SEEN == [("detector 1", 10), ("detector 3", 35), ("detector 5", 60), ("detector 8", 85)]


@pytest.mark.long
def test_zero_costs_nothing_and_changes_nothing(run: Any) -> None:
    plain = run(Camera, Detector, Planner, ms=100)
    same = run(Camera, Detector, Planner, ms=100, executors=[{"workers": 8}])
    assert same.result.digest == plain.result.digest


@pytest.mark.long
def test_a_single_threaded_executor_runs_one_callback_of_all_nodes_at_a_time(run: Any) -> None:
    run(
        lambda: Camera(50),
        lambda: Detector(name="a"),
        lambda: Detector(name="b"),
        ms=120,
        executors="single_threaded",
        execution={"nodes": {"/a": "15ms", "/b": "15ms"}},
    )
    assert SEEN == [("a 1", 50), ("b 1", 65), ("a 2", 100), ("b 2", 115)]
    run(
        lambda: Camera(50),
        lambda: Detector(name="a"),
        lambda: Detector(name="b"),
        ms=120,
        executors="per_node",
        execution={"nodes": {"/a": "15ms", "/b": "15ms"}},
    )
    assert SEEN == [("a 1", 50), ("b 1", 50), ("a 2", 100), ("b 2", 100)]


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("workers", "starts"), [(1, [20, 50, 80, 110]), (2, [20, 20, 50, 50]), (4, [20, 20, 20, 20])]
)
def test_so_many_workers_so_many_callbacks_at_once(
    run: Any, workers: int, starts: list[int]
) -> None:
    run(
        lambda: Camera(20, QoSProfile(depth=1)),
        *(lambda name=name: Detector(1, name) for name in "abcd"),
        ms=20 if workers == 4 else 115,
        executors=[{"nodes": ["/a", "/b", "/c", "/d"], "workers": workers}],
        execution={"nodes": {f"/{name}": "30ms" for name in "abcd"}},
    )
    assert [at for _, at in SEEN][:4] == starts


@pytest.mark.parametrize(
    ("group", "starts"),
    [(MutuallyExclusiveCallbackGroup, [10, 35, 60]), (ReentrantCallbackGroup, [10, 20, 35])],
)
def test_groups_mean_what_they_say_on_several_workers(
    run: Any, group: Any, starts: list[int]
) -> None:
    run(
        Camera,
        lambda: Detector(group=group()),
        ms=65,
        executors=[{"nodes": ["/detector"], "workers": 2}],
        execution=DETECTOR_25,
    )
    assert [at for _, at in SEEN][:3] == starts


def test_timers_of_a_busy_node_are_late_and_skip_periods(run: Any) -> None:
    class Control(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("control")
            self.create_timer(0.01, lambda: SEEN.append(("fast", now_ms(self))))
            self.create_timer(0.05, lambda: SEEN.append(("slow", now_ms(self))))

    execution = {"entities": [{"entity": "*Control*", "constant": "0s"}], "nodes": {}}
    run(Control, ms=30, execution=execution)
    assert SEEN == [("fast", 10), ("fast", 20), ("fast", 30)]

    class Slow(Control):
        def __init__(self) -> None:
            super().__init__()
            timers = list(self.timers)
            timers[1].callback.__qualname__ = "heavy"

    run(Slow, ms=100, execution={"entities": [{"entity": "heavy", "constant": "25ms"}]})
    fast = [at for name, at in SEEN if name == "fast"]
    # At 50 the fast timer and the slow one are due; the slow one takes until 75, when the fast one
    # that was due at 60 runs late, and its next deadline is on the grid again.
    assert fast == [10, 20, 30, 40, 50, 75, 80, 90, 100]


def test_deadlines_are_missed_on_a_slow_computer(run: Any) -> None:
    missed: list[int] = []
    qos = QoSProfile(depth=10, deadline=Duration(nanoseconds=15 * MS))
    camera: list[Any] = []

    def make() -> Node:
        camera.append(Camera(10, qos, deadline=lambda status: missed.append(now_ms(camera[0]))))
        return camera[0]

    run(make, ms=100)
    assert missed == []
    camera.clear()
    run(make, ms=100, execution={"entities": [{"entity": "Camera.tick", "constant": "40ms"}]})
    assert missed


def test_durations_are_drawn_per_entity_and_are_in_the_trace(run: Any) -> None:
    execution = {"nodes": {"/detector": {"uniform": {"min": "1ms", "max": "9ms"}}}}

    def texts(recorded: Any, node: str) -> list[str]:
        with recorded.trace() as trace:
            ids = {e.id for e in trace.entities.values() if trace.node_of(e).name == node}
            return [
                decision_text(o.hash)
                for i in range(trace.event_count)
                for o in trace.outputs_of(i)
                if o.kind is OutputKind.DRAW and o.entity in ids
            ]

    first = texts(run(Camera, Detector, Planner, ms=100, execution=execution), "/detector")
    assert len(first) == 10
    assert all(text.startswith("takes ") for text in first)
    assert len(set(first)) == 10
    more = {"nodes": {**execution["nodes"], "/camera": "1ms"}}
    assert (
        texts(run(Camera, Detector, Planner, ms=100, execution=more), "/detector")[:9] == first[:9]
    )


def test_a_callback_that_waits_keeps_its_worker(run: Any) -> None:
    class Server(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("server")
            self.create_service(Trigger, "ask", lambda request, response: response)

    class Client(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("client")
            self.asker = self.create_client(
                Trigger, "ask", callback_group=MutuallyExclusiveCallbackGroup()
            )
            self.timer = self.create_timer(0.01, self.ask)

        def ask(self) -> None:
            self.timer.cancel()
            self.asker.call(Trigger.Request())
            SEEN.append(("answered", now_ms(self)))

    server_5 = {"nodes": {"/server": "5ms"}}
    run(Server, Client, ms=50, execution=server_5, executors=[{"workers": 3}])
    assert SEEN == [("answered", 15)]
    # One thread for all, as in rclpy: it waits for what only it could do.
    with pytest.raises(DeadlockError, match="/client"):
        run(Server, Client, ms=50, executors="single_threaded")


def test_a_blocked_callback_goes_on_with_what_it_sends_at_its_end(run: Any) -> None:
    class Sleeper(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("sleeper")
            self.publisher = self.create_publisher(UInt64, "found", 10)
            self.timer = self.create_timer(0.01, self.go)

        def go(self) -> None:
            self.timer.cancel()
            self.get_clock().sleep_for(Duration(nanoseconds=20 * MS))
            self.publisher.publish(UInt64(data=7))

    run(Sleeper, Planner, ms=100, execution={"nodes": {"/sleeper": "5ms"}})
    assert SEEN == [("planner 7", 35)]
