"""Names, remapping, parameters, logging and graph queries."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import Log, ParameterEvent, SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile
from std_msgs.msg import String, UInt64
from std_srvs.srv import Trigger

from rsltrace import NodeSpec
from rsltrace.errors import JobError, NodeError

pytestmark = pytest.mark.ros

FOUND: dict[str, Any] = {}


class Parametrized(Node):
    def __init__(self) -> None:
        super().__init__("plain", namespace="/own")
        for name, default in (
            ("flag", False),
            ("count", 1),
            ("ratio", 1.0),
            ("text", "x"),
            ("gains", [0.0]),
            ("names", ["a"]),
            ("deep.er", 0),
            ("file_only", 0),
            ("wild", 0),
        ):
            FOUND[name] = self.declare_parameter(name, default).value
        FOUND["name"] = self.get_fully_qualified_name()
        FOUND["topic"] = self.create_publisher(String, "chatter", 1).topic_name
        FOUND["private"] = self.create_publisher(String, "~/chatter", 1).topic_name
        FOUND["logger"] = self.get_logger().name


def test_name_namespace_remappings_and_parameters_as_ros2_run_gives_them(
    simulate: Any, tmp_path: Path
) -> None:
    FOUND.clear()
    (tmp_path / "params.yaml").write_text(
        "/**:\n  ros__parameters: {wild: 3, file_only: 1}\n"
        "/robot/renamed:\n  ros__parameters: {file_only: 2, count: 9}\n"
        "/robot/other:\n  ros__parameters: {file_only: 5}\n"
    )
    simulate(
        NodeSpec(
            node=Parametrized,
            name="renamed",
            namespace="/robot",
            parameters={
                "flag": True,
                "count": 2**40,
                "ratio": 2.0,
                "text": 'a "quoted" \\ text: with\nlines # and more',
                "gains": [1.0, 1e-300, -2.5],
                "names": ["1", "true", "né"],
                "deep": {"er": 4},
            },
            parameter_files=["params.yaml"],
            remappings={"chatter": "/elsewhere"},
        ),
        duration=1,
    )
    assert FOUND == {
        "flag": True,
        "count": 2**40,
        "ratio": 2.0,
        "text": 'a "quoted" \\ text: with\nlines # and more',
        "gains": [1.0, 1e-300, -2.5],
        "names": ["1", "true", "né"],
        "deep.er": 4,
        "file_only": 2,
        "wild": 3,
        "name": "/robot/renamed",
        "topic": "/elsewhere",
        "private": "/robot/renamed/chatter",
        "logger": "robot.renamed",
    }


def test_a_broken_parameter_file_is_named(simulate: Any, tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text("/**:\n  ros__parameters: [1, 2\n")
    with pytest.raises(JobError, match=r"nodes\[0\].*broken\.yaml"):
        simulate(NodeSpec(node=Parametrized, parameter_files=["broken.yaml"]), duration=1)


class Same(Node):
    def __init__(self, number: int) -> None:
        super().__init__("same")
        self.number = number
        self.heard: list[int] = []
        self.publisher = self.create_publisher(UInt64, "numbers", 10)
        self.create_subscription(UInt64, "numbers", lambda m: self.heard.append(m.data), 10)
        self.create_timer(1.0, self.tick)

    def tick(self) -> None:
        self.publisher.publish(UInt64(data=self.number))
        self.get_logger().info(f"{self.number} draws {random.random()}")


def test_two_nodes_of_one_name_are_kept_apart(simulate: Any, capfd: Any) -> None:
    made: list[Any] = []

    def same(number: int) -> Any:
        def make() -> Node:
            made.append(Same(number))
            return made[-1]

        return make

    def others(first: Any) -> None:
        made.clear()
        delay = {"default": {"uniform": {"min": 0, "max": "1ms"}}}
        recorded = simulate(same(1), same(2), duration=1.5, job={"delay": delay, "seed": 3})
        assert [sorted(node.heard) for node in made] == [[1, 2], [1, 2]]
        assert recorded.result.notes == ("several nodes are named /same",)
        with recorded.trace() as trace:
            nodes = [e for e in trace.entities.values() if e.kind.label == "node"]
        calls = {(met.node, met.count) for met in recorded.result.guarded}
        assert [node.name for node in nodes] == ["/same", "/same"]
        assert {("/same", 1), ("/same #2", 1)} <= calls
        first.append((recorded.result.digest, recorded.logs()))

    runs: list[Any] = []
    others(runs)
    others(runs)
    assert runs[0] == runs[1]
    one, two = runs[0][1]
    assert one.split()[0] == "1"
    assert two.split()[0] == "2"
    assert one.split()[2] != two.split()[2]  # each draws from a stream of its own


def test_nodes_of_one_name_in_one_process_share_the_publisher_of_logs(
    simulate: Any, capfd: Any
) -> None:
    """As rcl does, which warns of it."""

    def program() -> None:
        rclpy.init()
        first, second = Node("same"), Node("same")
        first.get_logger().info("first")
        second.get_logger().info("second")
        second.destroy_node()
        first.get_logger().info("nobody publishes this")

    def other() -> None:
        rclpy.init()
        node = Node("same")  # in a process of its own
        node.get_logger().info("other")

    recorded = simulate(NodeSpec(main=program), NodeSpec(main=other))
    assert recorded.logs() == ["first", "second", "other"]


def test_parameter_services_events_and_callbacks(simulate: Any) -> None:
    log: list[Any] = []

    class Tuned(Node):
        def __init__(self) -> None:
            super().__init__("tuned")
            self.declare_parameter("speed", 1.0)
            self.add_on_set_parameters_callback(self.check)

        def check(self, parameters: list[Parameter]) -> SetParametersResult:
            return SetParametersResult(successful=parameters[0].value < 5, reason="too fast")

    class Tuner(Node):
        def __init__(self) -> None:
            super().__init__("tuner")
            group = ReentrantCallbackGroup()
            self.client = AsyncParameterClient(self, "/tuned", callback_group=group)
            self.create_subscription(ParameterEvent, "/parameter_events", self.event, 10)
            self.timer = self.create_timer(1.0, self.tick)

        async def tick(self) -> None:
            self.timer.cancel()
            for value in (2.0, 9.0):
                response = await self.client.set_parameters([Parameter("speed", value=value)])
                log.append((response.results[0].successful, response.results[0].reason))
            response = await self.client.get_parameters(["speed"])
            log.append(response.values[0].double_value)
            response = await self.client.list_parameters()
            log.append(response.result.names)

        def event(self, event: ParameterEvent) -> None:
            if event.node == "/tuned" and event.changed_parameters:
                log.append(f"changed {event.changed_parameters[0].name}")

    simulate(Tuned, Tuner, duration=2)
    assert (True, "") in log
    assert (False, "too fast") in log
    assert log.count("changed speed") == 1
    assert 2.0 in log
    assert any(isinstance(entry, list) and "speed" in entry for entry in log)


def test_log_records_are_stamped_kept_and_can_be_subscribed_to(simulate: Any) -> None:
    heard: list[tuple[str, int, str]] = []

    class Talker(Node):
        def __init__(self) -> None:
            super().__init__("talker", namespace="/ns")
            self.get_logger().warning("constructing")
            self.create_timer(1.5, lambda: self.get_logger().error("oh no"))

    class Hearer(Node):
        def __init__(self) -> None:
            super().__init__("hearer")
            self.create_subscription(
                Log, "/rosout", lambda m: heard.append((m.name, m.level, m.msg)), 10
            )

    recorded = simulate(Hearer, Talker, duration=2)
    assert heard == [("ns.talker", 30, "constructing"), ("ns.talker", 40, "oh no")]
    with recorded.trace() as trace:
        stamps = [stamp for stamp, _, _ in trace.messages("/rosout")]
        first = trace.decode("/rosout", next(iter(trace.messages("/rosout")))[2])
    assert stamps == [0, 1_500_000_000]
    assert first.function == "__init__"
    assert first.file == Path(__file__).name


def test_log_levels_of_one_run_do_not_leak_into_the_next(simulate: Any) -> None:
    class Quiet(Node):
        def __init__(self) -> None:
            super().__init__("quiet")
            self.get_logger().info("first")
            self.get_logger().set_level(50)
            self.get_logger().info("second")

    assert simulate(Quiet, duration=1).logs() == ["first"]
    assert simulate(Quiet, duration=1).logs() == ["first"]


def test_graph_queries(simulate: Any) -> None:
    from rclpy.node import NodeNameNonExistentError

    seen: dict[str, Any] = {}

    class Server(Node):
        def __init__(self) -> None:
            super().__init__("server", namespace="/a")
            self.create_publisher(UInt64, "numbers", QoSProfile(depth=3))
            self.create_service(Trigger, "ask", lambda q, r: r)

    class Curious(Node):
        def __init__(self) -> None:
            super().__init__("curious")
            self.create_subscription(UInt64, "/a/numbers", print, 1)
            client = self.create_client(Trigger, "/a/ask")
            seen["ready"] = client.service_is_ready()
            seen["nodes"] = self.get_node_names_and_namespaces()
            seen["topics"] = dict(self.get_topic_names_and_types())["/a/numbers"]
            seen["services"] = dict(self.get_service_names_and_types())["/a/ask"]
            seen["counts"] = (
                self.count_publishers("/a/numbers"),
                self.count_subscribers("/a/numbers"),
                self.count_services("/a/ask"),
                self.count_clients("/a/ask"),
                self.count_publishers("/none"),
            )
            info = self.get_publishers_info_by_topic("/a/numbers")[0]
            seen["info"] = (info.node_name, info.node_namespace, info.topic_type)
            seen["queue"] = info.qos_profile.history.name, info.qos_profile.depth
            seen["hash"] = str(info.topic_type_hash)
            names = self.get_publisher_names_and_types_by_node("server", "/a")
            seen["by_node"] = dict(names)["/a/numbers"]

            with pytest.raises(NodeNameNonExistentError, match="cannot get service names and ty"):
                self.get_service_names_and_types_by_node("nobody", "/")
            with pytest.raises(RuntimeError, match="failed to get service names and types: node n"):
                self.get_service_names_and_types_by_node("no body", "/")
            with pytest.raises(RuntimeError, match="failed to resolve name: topic name must not c"):
                self.resolve_topic_name("not valid")

    simulate(Server, Curious, duration=1)
    assert seen == {
        "ready": True,
        "nodes": [("server", "/a"), ("curious", "/")],
        "topics": ["std_msgs/msg/UInt64"],
        "services": ["std_srvs/srv/Trigger"],
        "counts": (1, 1, 1, 1, 0),
        "info": ("server", "/a", "std_msgs/msg/UInt64"),
        "queue": ("UNKNOWN", 0),  # as DDS does not tell them
        "hash": "RIHS01_fbdc52018fc13755dce18024d1a671c856aa8b4aaf63adfb095b608f98e8c943",
        "by_node": ["std_msgs/msg/UInt64"],
    }


def test_matched_events_reach_their_callbacks(simulate: Any) -> None:
    from rclpy.event_handler import PublisherEventCallbacks

    seen: list[tuple[int, int]] = []

    class Watcher(Node):
        def __init__(self) -> None:
            super().__init__("watcher")
            callbacks = PublisherEventCallbacks(
                matched=lambda s: seen.append((s.current_count, s.current_count_change))
            )
            self.sub: Any = None
            self.pub: Any = None
            self.callbacks = callbacks
            self.create_timer(1.0, self.toggle)

        def toggle(self) -> None:
            if self.pub is None:
                self.create_subscription(UInt64, "n", print, 1)
                self.pub = self.create_publisher(UInt64, "n", 1, event_callbacks=self.callbacks)
            elif self.sub is None:
                self.sub = self.create_subscription(UInt64, "n", print, 1)
            else:
                self.destroy_subscription(self.sub)
                self.sub = None

    simulate(Watcher, duration=3)
    assert seen == [(1, 1), (2, 1), (1, -1)]


def test_invalid_names_raise_what_rclpy_raises(simulate: Any) -> None:
    from rclpy.exceptions import InvalidTopicNameException

    class Bad(Node):
        def __init__(self) -> None:
            super().__init__("bad")
            with pytest.raises(InvalidTopicNameException):
                self.create_publisher(String, "not valid", 1)
            with pytest.raises(InvalidTopicNameException):
                self.create_subscription(String, "/1/x", print, 1)

    simulate(Bad, duration=1)
    with pytest.raises(NodeError, match="InvalidNodeNameException"):
        simulate(lambda: Node("no spaces please"), duration=1)


def test_rclpy_shutdown_in_a_callback_ends_the_run(simulate: Any) -> None:
    import rclpy

    class Done(Node):
        def __init__(self) -> None:
            super().__init__("done")
            self.create_timer(1.0, rclpy.shutdown)

    recorded = simulate(Done, duration=10)
    assert recorded.result.stop_reason == "/done called rclpy.shutdown()"
    assert recorded.result.exit_code == 0
    assert recorded.result.end_ns == 1_000_000_000
    assert not rclpy.ok()
