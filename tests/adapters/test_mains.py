"""Executables as they are: ``main()`` functions with their own init, executors and shutdown."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    MultiThreadedExecutor,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.node import Node
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

from rsltrace import NodeSpec
from rsltrace.errors import DeadlockError, NodeError
from rsltrace.trace.model.event import OutputKind

pytestmark = pytest.mark.ros


def seconds(node: Node) -> float:
    return float(node.get_clock().now().nanoseconds) / 1e9


def main_spec(main: Any, *words: str, **options: Any) -> NodeSpec:
    return NodeSpec(main=main, arguments=list(words), **options)


class Counter(Node):
    """Publishes 1, 2, 3, … every half second."""

    def __init__(self) -> None:
        super().__init__("counter")
        self.publisher = self.create_publisher(UInt64, "numbers", 10)
        self.count = 0
        self.create_timer(0.5, self.tick)

    def tick(self) -> None:
        self.count += 1
        self.publisher.publish(UInt64(data=self.count))


def listener(log: list[Any], name: str = "listener", depth: int = 10) -> Node:
    node = Node(name)
    node.create_subscription(
        UInt64, "numbers", lambda m: log.append((m.data, seconds(node))), depth
    )
    return node


def test_mains_spin_and_are_told_to_end_as_by_ctrl_c(simulate: Any) -> None:
    log: list[Any] = []
    ends: list[str] = []

    def talk() -> None:
        rclpy.init()
        node = Counter()
        try:
            rclpy.spin(node)
        except KeyboardInterrupt:
            ends.append(f"talk interrupted, context {'up' if rclpy.ok() else 'down'}")
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
            ends.append("talk ended")

    def listen() -> None:
        try:
            context = Context()
            rclpy.init(context=context)
            node = Node("other", context=context)
            node.create_subscription(UInt64, "numbers", lambda m: log.append(m.data), 10)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            executor.spin()
        except (KeyboardInterrupt, ExternalShutdownException) as error:
            ends.append(f"listen: {type(error).__name__}")

    recorded = simulate(main_spec(talk), main_spec(listen), duration=2)
    assert log == [1, 2, 3, 4]
    assert ends == ["talk interrupted, context down", "talk ended", "listen: KeyboardInterrupt"]
    assert recorded.result.notes == ()
    with recorded.trace() as trace:
        mains = [
            e.name.rpartition(".")[2] for e in trace.entities.values() if e.kind.label == "main"
        ]
    assert mains == ["talk", "listen"]
    kinds = recorded.kinds()
    assert kinds == ["construct"] * 2 + ["timer", "subscription"] * 4 + ["resume"] * 2


@pytest.mark.long
def test_every_main_has_its_own_arguments_and_default_context(simulate: Any) -> None:
    seen: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("program")
        node.declare_parameter("gain", 0.0)
        seen.append(
            (sys.argv[1:], node.get_fully_qualified_name(), node.get_parameter("gain").value)
        )
        node.create_publisher(UInt64, "numbers", 1)
        rclpy.spin_once(node, timeout_sec=1.0)
        seen.append(
            (sys.argv[1:], rclpy.ok(), rclpy.utilities.get_default_context() is node.context)
        )
        rclpy.shutdown()
        seen.append(rclpy.ok())

    before = list(sys.argv)
    recorded = simulate(
        main_spec(program, "--fast", name="one", parameters={"gain": 1.5}),
        main_spec(program, "x", "--ros-args", "-r", "__ns:=/two", "-p", "gain:=2.5"),
        main_spec(program, remappings={"numbers": "counts"}, namespace="/three"),
        duration=5,
    )
    two = ["x", "--ros-args", "-r", "__ns:=/two", "-p", "gain:=2.5"]
    assert seen[:3] == [
        (["--fast"], "/one", 1.5),
        (two, "/two/program", 2.5),
        ([], "/three/program", 0.0),
    ]
    assert seen[3:] == [
        (["--fast"], True, True), False, (two, True, True), False, ([], True, True), False,
    ]  # fmt: skip
    assert sys.argv == before
    with recorded.trace() as trace:
        topics = [e.name for e in trace.entities.values() if "/UInt64" in e.type]
    assert topics == ["/numbers", "/two/numbers", "/three/counts"]
    assert recorded.result.stop_reason == "every main has ended"
    assert recorded.result.sim_seconds == "1.000000000"


def test_callbacks_of_a_node_nobody_spins_do_not_run_and_its_queue_has_its_depth(
    simulate: Any,
) -> None:
    log: list[Any] = []

    def late() -> None:
        rclpy.init()
        node = listener(log, depth=2)
        idle = listener(log, "idle")
        time.sleep(2.2)
        assert log == []
        rclpy.spin_once(node)
        log.append(("between", seconds(node)))
        rclpy.spin_once(node)
        rclpy.spin_once(node, timeout_sec=0.1)
        log.append(("timed out", seconds(node)))
        idle.destroy_node()

    recorded = simulate(Counter, main_spec(late), duration=4)
    assert log == [(3, 2.2), ("between", 2.2), (4, 2.2), ("timed out", 2.3)]
    assert any("late ended at 2.300000000 s" in note for note in recorded.result.notes)


def test_a_main_that_never_spins_is_said(simulate: Any) -> None:
    def hasty() -> None:
        rclpy.init()
        Counter()

    recorded = simulate(main_spec(hasty), duration=3)
    (note,) = recorded.result.notes
    assert note.endswith(
        "hasty ended at 0.000000000 s without ever spinning: no callback of /counter has run"
    )
    assert recorded.kinds() == ["construct"]


def test_what_a_callback_raises_comes_out_of_spin(simulate: Any) -> None:
    caught: list[str] = []

    def careful() -> None:
        rclpy.init()
        node = Node("careful")
        node.create_timer(1.0, lambda: 1 / 0)
        for _ in range(2):
            try:
                rclpy.spin(node)
            except ZeroDivisionError as error:
                caught.append(str(error))
        raise SystemExit(7)

    recorded = simulate(main_spec(careful), duration=10)
    assert caught == ["division by zero"] * 2
    assert recorded.result.exit_code == 7
    (note,) = recorded.result.notes
    assert "careful exited with 7 at 2.000000000 s" in note


def test_an_exception_nobody_catches_ends_the_run_and_names_the_callback(simulate: Any) -> None:
    def careless() -> None:
        rclpy.init()
        node = Node("careless")
        node.create_timer(1.0, lambda: 1 / 0)
        rclpy.spin(node)

    with pytest.raises(NodeError) as caught:
        simulate(main_spec(careless), duration=10)
    assert str(caught.value).startswith("/careless: timer test_an_exception")
    assert "at simulated time 1.000000000 s raised ZeroDivisionError" in str(caught.value)
    assert "1 / 0" in caught.value.traceback_text


def test_spin_until_future_complete_and_a_missing_server(simulate: Any) -> None:
    log: list[Any] = []

    class Server(Node):
        def __init__(self) -> None:
            super().__init__("server")
            self.create_service(Trigger, "ask", self.answer)

        def answer(self, request: Any, response: Any) -> Any:
            response.message = f"at {seconds(self)}"
            return response

    def client() -> None:
        rclpy.init()
        node = Node("client")
        client = node.create_client(Trigger, "ask")
        while not client.wait_for_service(timeout_sec=1.0):
            log.append("waiting")
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future)
        log.append(future.result().message)
        missing = node.create_client(Trigger, "nobody")
        future = missing.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future, timeout_sec=1.5)
        log.append((future.done(), seconds(node)))
        rclpy.spin_until_future_complete(node, future)

    def server() -> None:
        rclpy.init()
        rclpy.spin(Server())

    with pytest.raises(DeadlockError) as caught:
        simulate(main_spec(client), main_spec(server))
    assert log == ["at 0.25", (False, 1.75)]
    assert "client waits for a future to be completed" in str(caught.value)
    assert "rclpy.spin_until_future_complete(node, future)" not in str(caught.value)
    assert "server waits" not in str(caught.value), "whoever spins waits for more work, for ever"


def test_a_service_call_on_ones_own_single_threaded_executor_is_a_deadlock(simulate: Any) -> None:
    """As natively: the executor is in the callback and cannot run the response."""

    def program() -> None:
        rclpy.init()
        node = Node("selfish")
        group = ReentrantCallbackGroup()
        node.create_service(Trigger, "ask", lambda q, r: r, callback_group=group)
        client = node.create_client(Trigger, "ask", callback_group=group)
        node.create_timer(1.0, lambda: client.call(Trigger.Request()), callback_group=group)
        rclpy.spin(node)

    with pytest.raises(DeadlockError, match=r"/selfish: timer .* waits for the response"):
        simulate(main_spec(program))


def test_domains_of_one_program_are_noted_as_they_meet(simulate: Any) -> None:
    def program() -> None:
        for domain in (0, 3):
            context = rclpy.context.Context()
            rclpy.init(context=context, domain_id=domain)
            found = Node(f"in_{domain}", context=context).get_node_names()
        assert found == ["in_0", "in_3"]

    notes = simulate(main_spec(program)).result.notes
    assert any("has nodes in domains [0, 3], which meet in a simulation" in note for note in notes)


def test_arguments_that_rcl_refuses_raise_what_rclpy_raises(simulate: Any) -> None:
    from rclpy.impl.implementation_singleton import rclpy_implementation as real

    def program() -> None:
        with pytest.raises(real.UnknownROSArgsError, match=r"^\['--bogus'\]$"):
            rclpy.init(args=["--ros-args", "--bogus"])
        for arguments in ("abc", [3]):
            with pytest.raises(TypeError):
                rclpy.init(args=arguments)  # type: ignore[arg-type]
        with pytest.raises(real.RCLError, match="failed to initialize rcl: Couldn't parse remap"):
            rclpy.init(args=["--ros-args", "-r", "::"], context=rclpy.context.Context())

    simulate(main_spec(program))


def test_a_rate_of_a_node_that_nobody_spins_is_a_deadlock_that_says_so(simulate: Any) -> None:
    """As natively: its timer is nobody's."""

    def program() -> None:
        rclpy.init()
        Node("alone").create_rate(5.0).sleep()

    with pytest.raises(DeadlockError, match=r"a Rate, .*: an executor has to spin the node mean"):
        simulate(main_spec(program))


def test_an_executor_class_of_the_users_own(simulate: Any) -> None:
    order: list[str] = []

    class Picky(Executor):
        """The example of rclpy's documentation: one override."""

        def spin_once(self, timeout_sec: float | None = None) -> None:
            try:
                handler, _, node = self.wait_for_ready_callbacks(timeout_sec=timeout_sec)
            except (ShutdownException, TimeoutException):
                return
            order.append(node.get_name() if node else "task")
            handler()
            if handler.exception() is not None:
                raise handler.exception()

    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        executor = Picky()
        executor.add_node(Counter())
        executor.add_node(listener(log))
        task = executor.create_task(lambda: "made")
        executor.spin_once()
        order.append(task.result())
        executor.spin()

    simulate(main_spec(program), duration=1)
    assert [value for value, _ in log] == [1, 2]
    assert order == ["task", "made", *["counter", "listener"] * 2]


@pytest.mark.long
def test_polling_without_a_timeout_takes_time(simulate: Any) -> None:
    turns = 0

    def program() -> None:
        nonlocal turns
        rclpy.init()
        node = Node("poller")
        done: list[int] = []
        node.create_timer(0.25, lambda: done.append(1))
        while len(done) < 2:
            rclpy.spin_once(node, timeout_sec=0)
            turns += 1

    recorded = simulate(main_spec(program), duration=5)
    assert recorded.result.sim_seconds == "0.500000000"
    assert 900 < turns < 1100  # a look takes a millisecond, except the first at an instant
    assert recorded.kinds() == ["construct", "timer", "timer", "resume"]


@pytest.mark.long
def test_the_same_twice_gives_the_same_digest(simulate: Any) -> None:
    def run() -> str:
        log: list[Any] = []

        def listen() -> None:
            rclpy.init()
            rclpy.spin(listener(log))

        def talk() -> None:
            rclpy.init()
            rclpy.spin(Counter())

        return str(simulate(main_spec(listen), main_spec(talk), duration=3).result.digest)

    assert run() == run()


@pytest.mark.long
@pytest.mark.parametrize("record_it", [True, False])
def test_a_run_without_recording_has_as_many_events(record_it: bool, tmp_path: Any) -> None:
    from rsltrace import Job, StopSpec, record

    def program() -> None:
        rclpy.init()
        node = Counter()
        for _ in range(3):
            rclpy.spin_once(node)
            node.get_logger().info("turn")

    job = Job(nodes=[main_spec(program)], stop=StopSpec(duration=5), base_dir=tmp_path)
    assert record(job, tmp_path / "run.mcap" if record_it else None).events == 7


@pytest.mark.long
def test_wait_for_message_in_a_main_and_in_a_callback(simulate: Any) -> None:
    from rclpy.wait_for_message import wait_for_message

    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("waits")
        ok, message = wait_for_message(UInt64, node, "numbers")
        log.append((ok, message.data, seconds(node)))
        log.append(wait_for_message(UInt64, node, "silence", time_to_wait=0.25))
        log.append(seconds(node))

    class Asks(Node):
        def __init__(self) -> None:
            super().__init__("asks")
            self.once = self.create_timer(1.2, self.tick)

        def tick(self) -> None:
            self.once.cancel()
            log.append(wait_for_message(UInt64, self, "numbers")[1].data)

    simulate(Counter, Asks, main_spec(program), duration=3)
    assert log == [(True, 1, 0.5), (False, None), 0.75, 3]


def test_the_events_executor(simulate: Any) -> None:
    events_executor = pytest.importorskip("rclpy.experimental.events_executor")
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        executor = events_executor.EventsExecutor()
        executor.add_node(listener(log))
        executor.spin()

    simulate(Counter, main_spec(program), duration=1)
    assert log == [(1, 0.5), (2, 1.0)]


def test_a_main_that_has_cleaned_up_has_spun_all_the_same(simulate: Any) -> None:
    def program() -> None:
        rclpy.init()
        node = rclpy.create_node("tidy")
        rclpy.spin_once(node, timeout_sec=0.5)
        node.destroy_node()
        rclpy.shutdown()

    recorded = simulate(main_spec(program), duration=2)
    (note,) = recorded.result.notes
    assert note.endswith("program ended at 0.500000000 s")


def test_what_a_main_returns_is_its_exit_status(simulate: Any) -> None:
    assert simulate(main_spec(lambda: 3)).result.exit_code == 3
    assert simulate(main_spec(lambda: 0)).result.exit_code == 0
    result = simulate(main_spec(lambda: "no camera")).result
    assert result.exit_code == 1
    assert result.notes[0].endswith("exited with 1 at 0.000000000 s: no camera")


def test_exit_handlers_run_when_their_main_ends(simulate: Any) -> None:
    log: list[Any] = []

    def program(name: str, exit_ns: int) -> Any:
        def main() -> None:
            rclpy.init()
            node = Node(name)
            atexit.register(lambda: log.append((name, "first", seconds(node))))
            atexit.register(log.append, (name, "second"))
            atexit.register(log.append, "never")
            atexit.unregister(log.append)
            atexit.register(log.append, (name, "last"))
            time.sleep(exit_ns)

        return main_spec(main)

    simulate(program("one", 1), program("two", 9), duration=3)
    assert log == [
        ("one", "last"), ("one", "first", 1.0), ("two", "last"), ("two", "first", 1.0),
    ]  # fmt: skip


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "work",
    [
        lambda node: rclpy.spin_once(node, timeout_sec=0.5),
        lambda node: rclpy.spin(node),
        lambda node: time.sleep(0.5),
    ],
    ids=["spin_once", "spin", "sleep"],
)
def test_a_main_that_will_not_hear_of_the_end_is_left_behind(
    simulate: Any, work: Callable[[Node], None]
) -> None:
    def deaf() -> None:
        rclpy.init()
        node = Node("deaf")
        while True:
            try:
                work(node)
            except BaseException:
                continue

    log: list[str] = []

    def polite() -> None:
        rclpy.init()
        try:
            rclpy.spin(Counter())
        finally:
            log.append("ended")

    recorded = simulate(main_spec(deaf), main_spec(polite), duration=2)
    assert log == ["ended"]
    assert recorded.result.stop_reason == "duration of 2.000000000 s"


def test_a_simulation_steps_through_mains(tmp_path: Any) -> None:
    import rsltrace

    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = listener(log)
        try:
            rclpy.spin(node)
        except KeyboardInterrupt:
            log.append("ended")

    job = rsltrace.Job(
        nodes=[main_spec(program)], stop=rsltrace.StopSpec(duration=9), base_dir=tmp_path
    )
    with rsltrace.Simulation(job) as sim:
        sim.run_for(1.0)
        sim.publish("/numbers", UInt64(data=5))
        sim.run_for(0.5)
        assert [value for value, _ in log] == [5]
        sim.publish("/numbers", UInt64(data=6))
        sim.run_for(0.5)
    assert [entry if isinstance(entry, str) else entry[0] for entry in log] == [5, 6, "ended"]


def test_a_callback_with_an_execution_time_keeps_its_executor_busy(simulate: Any) -> None:
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("slow")
        node.create_timer(1.0, lambda: log.append(("a", seconds(node))))
        node.create_timer(1.25, lambda: log.append(("b", seconds(node))))
        rclpy.spin(node)

    simulate(
        main_spec(program),
        duration=3.5,
        job={"execution": {"nodes": {"/slow": {"constant": "0.5s"}}}},
    )
    assert log == [
        ("a", 1.0),
        ("b", 1.5),
        ("a", 2.0),
        ("b", 2.5),
        ("a", 3.0),
    ]


def test_an_execution_time_keeps_the_callback_group_busy_among_several_threads(
    simulate: Any,
) -> None:
    log: list[Any] = []

    def program() -> None:
        rclpy.init()
        node = Node("slow")
        reentrant = ReentrantCallbackGroup()
        node.create_timer(1.0, lambda: log.append(("a", seconds(node))))
        node.create_timer(1.25, lambda: log.append(("b", seconds(node))))
        node.create_timer(1.25, lambda: log.append(("r", seconds(node))), callback_group=reentrant)
        executor = MultiThreadedExecutor(3)
        executor.add_node(node)
        executor.spin()

    simulate(
        main_spec(program),
        duration=2,
        job={"execution": {"nodes": {"/slow": {"constant": "0.5s"}}}},
    )
    assert log == [("a", 1.0), ("r", 1.25), ("b", 1.5), ("a", 2.0)]


@pytest.mark.long
def test_a_program_keeps_no_more_than_the_last_of_its_failures(simulate: Any) -> None:
    from rsltrace.adapters.rclpy.concurrency.program import _FAILURES_MAX, SimulatedProgram

    kept: list[int] = []

    class Faulty(Node):
        def __init__(self) -> None:
            super().__init__("faulty")
            self.count = 0
            self.create_timer(0.1, self.tick)

        def tick(self) -> None:
            self.count += 1
            raise KeyError(self.count)

    def main() -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        rclpy.init()
        executor = SingleThreadedExecutor()
        executor.add_node(Faulty())
        for number in range(3 * _FAILURES_MAX):
            with pytest.raises(KeyError, match=str(number + 1)):
                executor.spin_once()
        import gc

        gc.unfreeze()
        held = [each for each in gc.get_objects() if isinstance(each, SimulatedProgram)]
        kept.extend(len(each.failures) for each in held if each.entry and each.failures)
        rclpy.shutdown()

    simulate(NodeSpec(main=main))
    assert kept == [_FAILURES_MAX]


@pytest.mark.long
def test_what_belongs_to_a_context_that_is_down_can_do_little_more(simulate: Any) -> None:
    from rclpy.action import ActionClient, get_action_names_and_types
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from test_msgs.action import Fibonacci

    refused: list[str] = []
    heard: list[int] = []

    def program() -> None:
        rclpy.init()
        node = Counter()
        client = node.create_client(Trigger, "~/ask")
        action = ActionClient(node, Fibonacci, "fibonacci")
        context = rclpy.utilities.get_default_context()
        try:
            rclpy.spin(node)
        except KeyboardInterrupt:
            pass
        assert not rclpy.ok()
        for attempt in (
            lambda: node.publisher.publish(UInt64(data=99)),
            node.publisher.get_subscription_count,
            lambda: node.declare_parameter("gain", 1.0),  # is told on /parameter_events
            lambda: node.create_publisher(UInt64, "more", 1),
            lambda: node.create_subscription(UInt64, "more", print, 1),
            lambda: node.create_client(Trigger, "more"),
            lambda: node.create_service(Trigger, "more", print),
            lambda: node.create_timer(1.0, print),
            lambda: node.create_guard_condition(print),
            client.service_is_ready,
            action.server_is_ready,
            node.get_node_names,
            node.get_topic_names_and_types,
            lambda: node.count_publishers("numbers"),
            lambda: node.get_publishers_info_by_topic("numbers"),
            lambda: node.get_client_names_and_types_by_node(node.get_name(), "/"),
            lambda: get_action_names_and_types(node),
            node.publisher.assert_liveliness,
            node.publisher.wait_for_all_acked,
            context.handle.shutdown,
        ):
            with pytest.raises(rclpy_implementation.RCLError) as error:
                attempt()
            refused.append(str(error.value))
        node.get_logger().info("still heard")
        node.destroy_node()

    simulate(
        main_spec(program),
        lambda: listener(heard),
        duration=1.2,  # type: ignore[arg-type]
    )
    assert refused[:2] == [
        "Failed to publish: publisher's context is invalid",
        "failed to get subscription count: publisher's context is invalid",
    ]
    node_is_down = "rcl node's context is invalid"
    assert refused[3] == f"Failed to create publisher: {node_is_down}"
    assert refused[11:-1] == [
        f"Failed to get node names: {node_is_down}",
        f"failed to get topic names and types: {node_is_down}",
        f"Error in rcl_count_publishers: {node_is_down}",
        f"Failed to get information by topic for publishers: {node_is_down}",
        f"failed to get client names and types: {node_is_down}",
        f"Failed to get action names and type: {node_is_down}",
        "Failed to assert liveliness on the Publisher: publisher's context is invalid",
        "Failed to wait for all acknowledgements: publisher's context is invalid",
    ]
    assert refused[-1].startswith("failed to shutdown: rcl_shutdown already called")
    assert [number for number, _ in heard] == [1, 2]  # type: ignore[misc]


@pytest.mark.long
def test_after_a_shutdown_a_program_begins_anew(simulate: Any) -> None:
    heard: list[Any] = []

    def program() -> None:
        for _ in range(2):
            rclpy.init()
            node = Counter()
            rclpy.spin_once(node, timeout_sec=1.0)
            rclpy.shutdown()
            time.sleep(1.0)

    simulate(main_spec(program), lambda: listener(heard), duration=5)
    assert heard == [(1, 0.5), (1, 2.0)]


def test_every_main_has_its_own_event_loop(simulate: Any) -> None:
    log: list[Any] = []

    def program(name: str) -> Callable[[], None]:
        async def count(node: Node) -> None:
            for _ in range(2):
                rclpy.spin_once(node, timeout_sec=0.1)
                await asyncio.sleep(0.4)
                log.append((name, seconds(node), asyncio.get_event_loop()))

        def main() -> None:
            rclpy.init()
            loop = asyncio.new_event_loop()
            asyncio.set_event_loop(loop)
            node = Node(name)
            asyncio.get_event_loop().run_until_complete(count(node))
            assert asyncio.get_event_loop() is loop
            loop.close()

        return main

    simulate(main_spec(program("a")), main_spec(program("b")))
    assert [(name, round(at, 6)) for name, at, _ in log] == [
        ("a", 0.5),
        ("b", 0.5),
        ("a", 1.0),
        ("b", 1.0),
    ]
    assert log[0][2] is log[2][2] is not log[1][2]


def spins_in_threads(node: Node) -> None:
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    executor.spin()


def spins_in_a_thread(node: Node) -> None:
    thread = threading.Thread(target=rclpy.spin, args=(node,))
    thread.start()
    thread.join()


@pytest.mark.few(2)
@pytest.mark.parametrize("spin", [rclpy.spin, spins_in_threads, spins_in_a_thread])
@pytest.mark.parametrize("in_the_end", [False, True])
def test_a_callback_cut_off_by_the_end_of_the_run_has_done_nothing_wrong(
    simulate: Any, capfd: pytest.CaptureFixture[str], spin: Any, in_the_end: bool
) -> None:
    """Its context is down by then, so it cannot publish: nobody is told that it failed."""

    def main() -> None:
        rclpy.init()
        node = Node("slow", enable_rosout=False)
        publisher = node.create_publisher(UInt64, "numbers", 10)

        def tick() -> None:
            while True:
                try:
                    time.sleep(0.4)
                finally:
                    if in_the_end or rclpy.ok():
                        publisher.publish(UInt64(data=1))
                publisher.publish(UInt64(data=2))

        node.create_timer(0.3, tick, callback_group=ReentrantCallbackGroup())
        with contextlib.suppress(KeyboardInterrupt):
            spin(node)
        rclpy.try_shutdown()

    recorded = simulate(main_spec(main), duration=2)
    assert recorded.result.exit_code == 0
    assert not [note for note in recorded.result.notes if "raised" in note]
    said = capfd.readouterr()
    assert "invalid" not in said.out + said.err
    with recorded.trace() as trace:
        every = [trace.outputs_of(index) for index in range(trace.event_count)]
    outputs = [output.kind for outputs in every for output in outputs]
    assert OutputKind.MESSAGE in outputs
    assert OutputKind.EXCEPTION not in outputs
