"""Services, futures, coroutines, tasks, callback groups: rclpy's semantics on simulated time."""

from __future__ import annotations

from typing import Any

import pytest
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import UInt64
from std_srvs.srv import SetBool, Trigger

from rsltrace.errors import DeadlockError, NodeError

pytestmark = pytest.mark.ros


class Server(Node):
    def __init__(self) -> None:
        super().__init__("server")
        self.count = 0
        self.create_service(Trigger, "ask", self.answer)

    def answer(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.count += 1
        response.success = True
        response.message = str(self.count)
        return response


def test_call_async_with_a_done_callback_is_one_event(simulate: Any) -> None:
    got: list[str] = []

    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            self.client = self.create_client(Trigger, "ask")
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            assert self.client.service_is_ready()
            assert self.client.wait_for_service(timeout_sec=0.0)
            future = self.client.call_async(Trigger.Request())
            future.add_done_callback(lambda f: got.append(f.result().message))

    recorded = simulate(Server, Asker, duration=3)
    assert got == ["1", "2", "3"]
    events = recorded.events()
    kinds = [event.kind.label for event in events]
    middle = [kind for kind in kinds if kind not in ("construct", "shutdown")]
    assert middle == ["timer", "service", "client"] * 3
    timer, service, client = (
        event for event in events[2:5] if event.kind.label in ("timer", "service", "client")
    )
    assert (service.cause_event, client.cause_event) == (timer.index, service.index)


def test_awaiting_a_call_suspends_and_resumes(simulate: Any) -> None:
    log: list[Any] = []

    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            self.client = self.create_client(Trigger, "ask")
            self.create_timer(1.0, self.tick, callback_group=ReentrantCallbackGroup())

        async def tick(self) -> None:
            log.append("ask")
            response = await self.client.call_async(Trigger.Request())
            log.append(response.message)
            response = await self.client.call_async(Trigger.Request())
            log.append(response.message)

    recorded = simulate(Server, Asker, duration=1)
    assert log == ["ask", "1", "2"]
    kinds = [k for k in recorded.kinds() if k not in ("construct", "shutdown")]
    assert kinds == ["timer", "service", "client", "resume", "service", "client", "resume"]
    flags = [int(e.flags) for e in recorded.events() if e.kind.label in ("timer", "resume")]
    assert flags == [2, 2, 0]


def test_async_service_callbacks_may_call_other_services(simulate: Any) -> None:
    got: list[str] = []

    class Middle(Node):
        def __init__(self) -> None:
            super().__init__("middle")
            group = ReentrantCallbackGroup()
            self.client = self.create_client(Trigger, "ask", callback_group=group)
            self.create_service(SetBool, "relay", self.relay, callback_group=group)

        async def relay(self, request: Any, response: Any) -> Any:
            inner = await self.client.call_async(Trigger.Request())
            response.success = request.data
            response.message = f"relayed {inner.message}"
            return response

    class Asker(Node):
        def __init__(self) -> None:
            super().__init__("asker")
            self.client = self.create_client(SetBool, "relay")
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            future = self.client.call_async(SetBool.Request(data=True))
            future.add_done_callback(lambda f: got.append(f.result().message))

    simulate(Server, Middle, Asker, duration=2)
    assert got == ["relayed 1", "relayed 2"]


def test_a_suspended_callback_keeps_its_mutually_exclusive_group_busy(simulate: Any) -> None:
    log: list[str] = []

    class Busy(Node):
        def __init__(self, same_group: bool) -> None:
            super().__init__("busy")
            first = MutuallyExclusiveCallbackGroup()
            second = first if same_group else MutuallyExclusiveCallbackGroup()
            self.gate = Future()
            self.publisher = self.create_publisher(UInt64, "n", 10)
            self.create_subscription(UInt64, "n", self.slow, 10, callback_group=first)
            self.create_timer(0.5, self.tick, callback_group=second)
            self.create_timer(
                2.2, lambda: self.gate.set_result(None), callback_group=ReentrantCallbackGroup()
            )
            self.create_timer(0.3, self.start, callback_group=ReentrantCallbackGroup())
            self.started = False

        def start(self) -> None:
            if not self.started:
                self.started = True
                self.publisher.publish(UInt64())

        async def slow(self, message: UInt64) -> None:
            log.append("slow begins")
            await self.gate
            log.append("slow ends")

        def tick(self) -> None:
            log.append(f"tick {self.get_clock().now().nanoseconds // 10**8}")

    simulate(lambda: Busy(False), duration=2.4)
    assert log == ["slow begins", "tick 5", "tick 10", "tick 15", "tick 20", "slow ends"]
    log.clear()
    simulate(lambda: Busy(True), duration=2.6)
    # The overdue timer runs once as soon as the group is free, then is on its grid again.
    assert log == ["slow begins", "slow ends", "tick 22", "tick 25"]


def test_create_task_runs_functions_and_coroutines_in_order(simulate: Any) -> None:
    log: list[Any] = []

    class Tasks(Node):
        def __init__(self) -> None:
            super().__init__("tasks")
            self.create_timer(1.0, self.tick)
            self.publisher = self.create_publisher(UInt64, "n", 10)
            self.create_subscription(UInt64, "n", lambda m: log.append("message"), 10)

        def tick(self) -> None:
            assert self.executor is not None
            self.publisher.publish(UInt64())
            first = self.executor.create_task(lambda: log.append("plain") or 7)
            first.add_done_callback(lambda f: log.append(("done", f.result())))
            self.executor.create_task(self.coroutine, first)
            log.append("tick")

        async def coroutine(self, first: Future) -> None:
            log.append(("awaited", await first))

    simulate(Tasks, duration=1)
    # Tasks go before the message that was published earlier, as rclpy's executors do it.
    assert log == ["tick", "plain", ("awaited", 7), ("done", 7), "message"]


def test_a_coroutine_that_yields_to_others_is_polled(simulate: Any) -> None:
    log: list[str] = []

    class Yield:
        def __await__(self) -> Any:
            yield

    class Polite(Node):
        def __init__(self) -> None:
            super().__init__("polite")
            self.create_timer(1.0, self.tick, callback_group=ReentrantCallbackGroup())
            self.create_timer(1.0, lambda: log.append("other"))

        async def tick(self) -> None:
            log.append("before")
            await Yield()
            log.append("after")

    simulate(Polite, duration=2)
    assert log == ["before", "other", "after"] * 2


def test_waiting_for_what_never_comes_is_named(simulate: Any) -> None:
    class Hopeful(Node):
        def __init__(self) -> None:
            super().__init__("hopeful")
            self.client = self.create_client(Trigger, "/nobody")
            self.timer = self.create_timer(1.0, self.tick)

        async def tick(self) -> None:
            self.timer.cancel()
            await self.client.call_async(Trigger.Request())

    with pytest.raises(DeadlockError) as error:
        simulate(Hopeful)
    for word in ("/hopeful", "Hopeful.tick", "/nobody", "0 servers", __file__):
        assert word in str(error.value)


def test_awaiting_a_client_of_the_same_group_is_explained(simulate: Any) -> None:
    # rclpy's executors hang here without a word.
    class Own(Node):
        def __init__(self) -> None:
            super().__init__("own")
            self.client = self.create_client(Trigger, "ask")
            self.timer = self.create_timer(1.0, self.tick)

        async def tick(self) -> None:
            self.timer.cancel()
            await self.client.call_async(Trigger.Request())

    with pytest.raises(DeadlockError, match="has arrived, but its client shares"):
        simulate(Server, Own)


def test_awaiting_a_server_of_the_same_group_is_explained(simulate: Any) -> None:
    class Own(Node):
        def __init__(self) -> None:
            super().__init__("own")
            own = ReentrantCallbackGroup()
            self.client = self.create_client(Trigger, "ask", callback_group=own)
            self.create_service(Trigger, "ask", lambda request, response: response)
            self.timer = self.create_timer(1.0, self.tick)

        async def tick(self) -> None:
            self.timer.cancel()
            await self.client.call_async(Trigger.Request())

    with pytest.raises(DeadlockError, match="request has arrived, but its server shares"):
        simulate(Own)


def test_a_server_that_returns_nothing_ends_the_run_with_its_name(simulate: Any) -> None:
    class Forgetful(Node):
        def __init__(self) -> None:
            super().__init__("forgetful")
            self.create_service(Trigger, "ask", lambda request, response: None)
            self.client = self.create_client(Trigger, "ask")
            self.create_timer(1.0, lambda: self.client.call_async(Trigger.Request()))

    with pytest.raises(NodeError, match=r"/forgetful: service /ask.* raised TypeError"):
        simulate(Forgetful, duration=2)
