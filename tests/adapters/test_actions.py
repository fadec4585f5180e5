"""Actions through rclpy's own Python layer, on simulated time."""

from __future__ import annotations

import time
from typing import Any

import pytest
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

pytestmark = pytest.mark.ros
test_msgs = pytest.importorskip("test_msgs.action", reason="needs ros-jazzy-test-msgs")
Fibonacci = test_msgs.Fibonacci


def seconds(node: Node) -> float:
    return float(node.get_clock().now().nanoseconds) / 1e9


class Server(Node):
    """Works a second per number; refuses negative orders; can be cancelled."""

    def __init__(self, **options: Any) -> None:
        super().__init__("server")
        self.server = ActionServer(
            self,
            Fibonacci,
            "fibonacci",
            self.work,
            goal_callback=lambda goal: (
                GoalResponse.ACCEPT if goal.order >= 0 else GoalResponse.REJECT
            ),
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
            **options,
        )

    def work(self, goal: Any) -> Any:
        feedback = Fibonacci.Feedback(sequence=[0, 1])
        for _ in range(goal.request.order):
            time.sleep(1.0)
            if goal.is_cancel_requested:
                goal.canceled()
                return Fibonacci.Result(sequence=feedback.sequence)
            feedback.sequence.append(feedback.sequence[-1] + feedback.sequence[-2])
            goal.publish_feedback(feedback)
        goal.succeed()
        told = "Failed to update goal state: .* transition from state SUCCEEDED with event ABORT"
        with pytest.raises(RuntimeError, match=told):
            goal.abort()
        return Fibonacci.Result(sequence=feedback.sequence)


class Client(Node):
    def __init__(self, order: int, log: list[Any], *, cancel_after: float | None = None) -> None:
        super().__init__("client")
        self.log, self.order, self.cancel_after = log, order, cancel_after
        self.client = ActionClient(self, Fibonacci, "fibonacci")
        self.once = self.create_timer(1.0, self.ask)

    def ask(self) -> None:
        self.once.cancel()
        assert self.client.server_is_ready()
        goal = Fibonacci.Goal(order=self.order)
        future = self.client.send_goal_async(goal, feedback_callback=self.feedback)
        future.add_done_callback(self.accepted)

    def feedback(self, message: Any) -> None:
        self.log.append((seconds(self), list(message.feedback.sequence)))

    def accepted(self, future: Any) -> None:
        self.goal = future.result()
        self.log.append((seconds(self), "accepted" if self.goal.accepted else "rejected"))
        if self.goal.accepted:
            self.goal.get_result_async().add_done_callback(self.done)
            if self.cancel_after is not None:
                self.create_timer(self.cancel_after, self.goal.cancel_goal_async)

    def done(self, future: Any) -> None:
        result = future.result()
        self.log.append((seconds(self), result.status, list(result.result.sequence)))


def test_a_goal_with_feedback_and_result(simulate: Any) -> None:
    log: list[Any] = []
    first = simulate(Server, lambda: Client(3, log), duration=10)
    assert log == [
        (1.0, "accepted"),
        (2.0, [0, 1, 1]),
        (3.0, [0, 1, 1, 2]),
        (4.0, [0, 1, 1, 2, 3]),
        (4.0, 4, [0, 1, 1, 2, 3]),
    ]
    second = simulate(Server, lambda: Client(3, log), duration=10)
    assert first.result.digest == second.result.digest  # goal ids included
    with second.trace() as trace:
        topics = {channel.topic for channel in trace.channels.values()}
        statuses = [
            [status.status for status in trace.decode("/fibonacci/_action/status", d).status_list]
            for _, _, d in trace.messages("/fibonacci/_action/status")
        ]
    assert "/rsltrace/request/fibonacci/_action/send_goal" in topics
    assert "/rsltrace/response/fibonacci/_action/get_result" in topics
    assert statuses == [[1], [2], [4]]


def test_a_goal_that_is_rejected(simulate: Any) -> None:
    log: list[Any] = []
    simulate(Server, lambda: Client(-1, log), duration=3)
    assert log == [(1.0, "rejected")]


def test_a_goal_that_is_cancelled(simulate: Any) -> None:
    log: list[Any] = []
    simulate(Server, lambda: Client(10, log, cancel_after=2.5), duration=20)
    assert log[-1] == (4.0, 5, [0, 1, 1, 2])


def test_several_goals_at_once_and_async_execute_callbacks(simulate: Any) -> None:
    log: list[Any] = []

    class Awaiting(Node):
        def __init__(self) -> None:
            super().__init__("server")
            self.gates: list[Any] = []
            self.create_timer(2.0, self.open)
            self.server = ActionServer(self, Fibonacci, "fibonacci", self.work)

        def open(self) -> None:
            gates, self.gates = self.gates, []
            for gate in gates:
                gate.set_result(None)

        async def work(self, goal: Any) -> Any:
            from rclpy.task import Future

            gate = Future(executor=self.executor)
            self.gates.append(gate)
            await gate
            goal.succeed()
            return Fibonacci.Result(sequence=[goal.request.order])

    class Two(Client):
        def ask(self) -> None:
            super().ask()
            self.order += 1
            super().ask()

    simulate(Awaiting, lambda: Two(7, log), duration=5)
    assert log == [(1.0, "accepted")] * 2 + [(2.0, 4, [7]), (2.0, 4, [8])]


def test_an_exception_in_execute_aborts_the_goal(simulate: Any, capfd: Any) -> None:
    log: list[Any] = []

    class Faulty(Server):
        def work(self, goal: Any) -> Any:
            raise RuntimeError("wheel lost")

    recorded = simulate(Faulty, lambda: Client(1, log), duration=3)
    assert log[-1] == (1.0, 6, [])
    assert any("wheel lost" in text for text in recorded.logs())
    assert "wheel lost" in capfd.readouterr().err


def test_results_expire_after_their_timeout(simulate: Any) -> None:
    log: list[Any] = []

    class Late(Client):
        def accepted(self, future: Any) -> None:
            self.goal = future.result()
            self.create_timer(4.0, self.fetch)
            self.create_timer(8.0, self.fetch)

        def fetch(self) -> None:
            self.goal.get_result_async().add_done_callback(self.done)

    simulate(lambda: Server(result_timeout=5), lambda: Late(1, log), duration=9.5)
    # Done at 2 s, kept until 7 s: there at 5 s, unknown at 9 s.
    assert [(entry[0], entry[1]) for entry in log if len(entry) == 3] == [
        (5.0, 4),
        (9.0, 0),
        (9.0, 0),
    ]


def test_a_blocking_client_in_a_callback(simulate: Any) -> None:
    log: list[Any] = []

    class Blocking(Node):
        def __init__(self) -> None:
            super().__init__("client")
            self.client = ActionClient(
                self, Fibonacci, "fibonacci", callback_group=ReentrantCallbackGroup()
            )
            assert self.client.wait_for_server(timeout_sec=5.0)
            self.once = self.create_timer(1.0, self.ask)

        def ask(self) -> None:
            self.once.cancel()
            result = self.client.send_goal(Fibonacci.Goal(order=2))
            log.append((seconds(self), list(result.result.sequence)))

    simulate(Blocking, Server, duration=10)
    assert log == [(3.25, [0, 1, 1, 2])]


def test_goals_whose_execution_is_deferred(simulate: Any) -> None:
    """A queue of goals, worked off one after the other, of which a waiting one is cancelled."""
    log: list[Any] = []

    class Queueing(Server):
        def __init__(self) -> None:
            super().__init__(handle_accepted_callback=self.accepted)
            self.waiting: list[Any] = []
            self.create_timer(2.0, self.next)

        def accepted(self, goal: Any) -> None:
            self.waiting.append(goal)

        def next(self) -> None:
            if self.waiting:
                goal = self.waiting.pop(0)
                log.append((seconds(self), "execute", goal.request.order, goal.status))
                goal.execute()

    class Three(Client):
        def ask(self) -> None:
            for order, cancel_after in ((1, None), (2, 1.5), (3, None)):
                self.order, self.cancel_after = order, None
                self.once.cancel()
                future = self.client.send_goal_async(Fibonacci.Goal(order=order))
                future.add_done_callback(
                    lambda done, after=cancel_after: self.sent(done.result(), after)
                )

        def sent(self, goal: Any, cancel_after: float | None) -> None:
            goal.get_result_async().add_done_callback(self.done)
            if cancel_after is not None:
                self.once = self.create_timer(
                    cancel_after, lambda: (self.once.cancel(), goal.cancel_goal_async())
                )

    simulate(Queueing, lambda: Three(0, log), duration=12)
    assert log == [
        (2.0, "execute", 1, 1),
        (3.0, 4, [0, 1, 1]),
        (4.0, "execute", 2, 3),  # is being cancelled
        (5.0, 5, [0, 1]),
        (6.0, "execute", 3, 1),
        (9.0, 4, [0, 1, 1, 2, 3]),
    ]


@pytest.mark.long
def test_a_destroyed_client_and_a_bad_name_raise_what_rclpy_raises(simulate: Any) -> None:
    class Gone(Node):
        def __init__(self) -> None:
            super().__init__("gone")
            client = ActionClient(self, Fibonacci, "count")
            client.destroy()
            with pytest.raises(RuntimeError, match="Failed to send goal request: action client po"):
                client.send_goal_async(Fibonacci.Goal())
            with pytest.raises(RuntimeError, match="Failed to check if action server is available"):
                client.wait_for_server(timeout_sec=0.1)
            for make in (
                lambda: ActionClient(self, Fibonacci, "x y"),
                lambda: ActionServer(self, Fibonacci, "x y", print),
            ):
                with pytest.raises(ValueError, match="due to invalid topic name 'x y'"):
                    make()

    simulate(Gone, duration=1)


def test_goal_ids_come_from_the_seed(simulate: Any) -> None:
    def goal_ids(seed: int) -> list[str]:
        seen: list[str] = []

        class Noting(Server):
            def work(self, goal: Any) -> Any:
                seen.append(bytes(goal.goal_id.uuid).hex())
                return super().work(goal)

        class Two(Client):
            def ask(self) -> None:
                super().ask()
                super().ask()

        simulate(Noting, lambda: Two(1, []), duration=4, job={"seed": seed})
        return seen

    first = goal_ids(1)
    assert len(set(first)) == 2
    assert all(text[12] == "4" for text in first)  # UUIDs of version 4
    assert goal_ids(1) == first
    assert not set(goal_ids(2)) & set(first)


def test_statuses_are_the_bytes_that_the_codec_makes_of_them(simulate: Any) -> None:
    from action_msgs.msg import GoalStatusArray

    from rsltrace.adapters.rclpy.messages.codec import codec_for

    log: list[Any] = []
    clients = [type(f"Client{n}", (Client,), {}) for n in range(4)]
    nodes = [lambda n=n: clients[n](2 + n, log) for n in range(4)]
    recorded = simulate(lambda: Server(result_timeout=2.0), *nodes, duration=12)
    codec = codec_for(GoalStatusArray)
    seen = set()
    with recorded.trace() as trace:
        for _, _, data in trace.messages("/fibonacci/_action/status"):
            message = codec.deserialize(bytes(data))
            seen.add(tuple(goal.status for goal in message.status_list))
            assert codec.serialize(message) == bytes(data)
    assert {len(statuses) for statuses in seen} == {1, 2, 3, 4}
    assert {status for statuses in seen for status in statuses} == {1, 2, 4}
