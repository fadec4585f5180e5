"""What nodes tell about themselves: type descriptions, service events, actions of the graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rclpy.action import (
    ActionClient,
    ActionServer,
    get_action_client_names_and_types_by_node,
    get_action_names_and_types,
    get_action_server_names_and_types_by_node,
)
from rclpy.node import Node
from rclpy.qos import qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from service_msgs.msg import ServiceEventInfo
from std_msgs.msg import String
from std_srvs.srv import SetBool
from type_description_interfaces.srv import GetTypeDescription

pytestmark = pytest.mark.ros


class Asker(Node):
    """Asks another node for descriptions of types, one after the other."""

    def __init__(self, questions: list[tuple[str, str, bool]], answers: list[Any]) -> None:
        super().__init__("asker")
        self.client = self.create_client(GetTypeDescription, "/described/get_type_description")
        self.questions, self.answers = list(questions), answers
        self.create_timer(1.0, self.ask)

    def ask(self) -> None:
        if self.questions:
            name, digest, sources = self.questions.pop(0)
            request = GetTypeDescription.Request(
                type_name=name, type_hash=digest, include_type_sources=sources
            )
            future = self.client.call_async(request)
            future.add_done_callback(lambda done: self.answers.append(done.result()))


def test_a_node_describes_the_types_it_uses(simulate: Callable[..., Any]) -> None:
    hashes: dict[str, str] = {}

    class Described(Node):
        def __init__(self) -> None:
            super().__init__("described")
            self.create_publisher(String, "text", 10)
            self.create_service(SetBool, "switch", lambda request, response: response)
            for info in self.get_publishers_info_by_topic("/text"):
                hashes["String"] = str(info.topic_type_hash)

    def questions() -> list[Node]:
        node = Described()
        asked = [
            ("std_msgs/msg/String", hashes["String"], True),
            ("std_msgs/msg/String", hashes["String"], False),
            ("std_msgs/msg/String", "RIHS01_" + "0" * 64, False),
            ("std_msgs/msg/String", "nonsense", False),
        ]
        return [node, Asker(asked, answers)]

    answers: list[Any] = []
    simulate(questions, duration=6.0)
    full, bare, unknown, nonsense = answers
    assert full.successful
    description = full.type_description.type_description
    assert description.type_name == "std_msgs/msg/String"
    assert [field.name for field in description.fields] == ["data"]
    assert [source.type_name for source in full.type_sources] == ["std_msgs/msg/String"]
    assert "string data" in full.type_sources[0].raw_file_contents
    assert bare.successful
    assert bare.type_description == full.type_description
    assert list(bare.type_sources) == []
    assert (unknown.successful, unknown.failure_reason) == (
        False,
        "Type not currently in use by this node",
    )
    assert (nonsense.successful, nonsense.failure_reason) == (False, "Failed to parse type hash")


def test_descriptions_hash_to_the_installed_type_hashes() -> None:
    pytest.importorskip("test_msgs.action", reason="needs ros-jazzy-test-msgs")
    from sensor_msgs.msg import PointCloud2
    from test_msgs.action import Fibonacci
    from test_msgs.msg import Arrays

    from rsltrace.adapters.rclpy.handles.services import type_description
    from rsltrace.adapters.rclpy.messages.interfaces import type_hash

    for interface in (String, PointCloud2, Arrays, SetBool, SetBool.Event, Fibonacci):
        found = type_description(interface)
        assert found is not None
        assert found.type_hash == type_hash(interface)
        message = found.message()
        names = [t.type_name for t in message.referenced_type_descriptions]
        assert names == sorted(names)  # REP 2016 orders them
        nested = {
            field.type.nested_type_name
            for t in [message.type_description, *message.referenced_type_descriptions]
            for field in t.fields
        } - {""}
        assert nested == set(names)  # every type it is made of, and no other


class Switch(Node):
    """A service and its client, both told to publish their service events."""

    def __init__(
        self, states: list[ServiceIntrospectionState], events: list[Any], calls: int = 1
    ) -> None:
        super().__init__("switch")
        self.events, self.calls = events, calls
        self.service = self.create_service(SetBool, "switch", self.serve)
        self.client = self.create_client(SetBool, "switch")
        self.create_subscription(SetBool.Event, "switch/_service_event", self.events.append, 100)
        self.states = list(states)
        self.create_timer(1.0, self.ask)

    def serve(self, request: Any, response: Any) -> Any:
        response.success = request.data
        response.message = "on"
        return response

    def ask(self) -> None:
        if self.states:
            state = self.states.pop(0)
            for end in (self.service, self.client):
                end.configure_introspection(self.get_clock(), qos_profile_system_default, state)
            self.client.call_async(SetBool.Request(data=True))


@pytest.mark.parametrize("contents", [False, True])
def test_service_events_are_messages(simulate: Callable[..., Any], contents: bool) -> None:
    events: list[Any] = []
    state = ServiceIntrospectionState.CONTENTS if contents else ServiceIntrospectionState.METADATA
    run = simulate(lambda: Switch([state], events), duration=3.0)
    kinds = [event.info.event_type for event in events]
    assert kinds == [
        ServiceEventInfo.REQUEST_SENT,
        ServiceEventInfo.REQUEST_RECEIVED,
        ServiceEventInfo.RESPONSE_SENT,
        ServiceEventInfo.RESPONSE_RECEIVED,
    ]
    assert {event.info.sequence_number for event in events} == {1}
    assert len({bytes(event.info.client_gid) for event in events}) == 1
    assert {(event.info.stamp.sec, event.info.stamp.nanosec) for event in events} == {(1, 0)}
    requests = [[r.data for r in event.request] for event in events]
    responses = [[(r.success, r.message) for r in event.response] for event in events]
    if contents:
        assert requests == [[True], [True], [], []]
        assert responses == [[], [], [(True, "on")], [(True, "on")]]
    else:
        assert requests == responses == [[], [], [], []]
    with run.trace() as trace:
        assert sum(1 for _ in trace.messages("/switch/_service_event")) == 4


def test_service_events_can_be_switched_off_and_on(simulate: Callable[..., Any]) -> None:
    events: list[Any] = []
    states = [
        ServiceIntrospectionState.METADATA,
        ServiceIntrospectionState.OFF,
        ServiceIntrospectionState.CONTENTS,
    ]
    simulate(lambda: Switch(states, events), duration=5.0)
    assert [event.info.stamp.sec for event in events] == [1] * 4 + [3] * 4
    assert [len(event.request) + len(event.response) for event in events] == [0] * 4 + [1] * 4


def test_the_graph_knows_its_actions(simulate: Callable[..., Any]) -> None:
    fibonacci = pytest.importorskip("test_msgs.action").Fibonacci
    seen: dict[str, Any] = {}

    class Both(Node):
        def __init__(self) -> None:
            super().__init__("both", namespace="/ns")
            self.server = ActionServer(self, fibonacci, "served", lambda goal: None)
            self.clients_ = [ActionClient(self, fibonacci, name) for name in ("served", "/far")]
            self.timer = self.create_timer(1.0, self.look)

        def look(self) -> None:
            seen["all"] = get_action_names_and_types(self)
            seen["client"] = get_action_client_names_and_types_by_node(self, "both", "/ns")
            seen["server"] = get_action_server_names_and_types_by_node(self, "both", "/ns")
            self.server.destroy()
            for client in self.clients_:
                client.destroy()
            seen["after"] = get_action_names_and_types(self)
            self.timer.cancel()

    simulate(Both, duration=2.0)
    types = ["test_msgs/action/Fibonacci"]
    assert seen == {
        "all": [("/far", types), ("/ns/served", types)],
        "client": [("/far", types), ("/ns/served", types)],
        "server": [("/ns/served", types)],
        "after": [],
    }


def test_what_rclpy_says_to_ros_arguments_it_does_not_know(simulate: Callable[..., Any]) -> None:
    from rclpy.impl.implementation_singleton import rclpy_implementation as real

    def node() -> Node:
        with pytest.raises(real.UnknownROSArgsError, match=r"\['strange', 'words'\]"):
            Node("one", cli_args=["--ros-args", "strange", "words"])
        with pytest.raises(real.RCLInvalidROSArgsError, match=r"Failed to parse.*not-a-remap"):
            Node("two", cli_args=["--ros-args", "-r", "not-a-remap"])
        with pytest.raises(real.UnknownROSArgsError, match="strange"):
            rclpy.init(args=["--ros-args", "strange"], context=rclpy.Context())
        with pytest.raises(UnicodeEncodeError):
            rclpy.init(args=["\udced"], context=rclpy.Context())
        return Node("three")

    simulate(node, duration=0.1)


def test_a_node_may_be_destroyed_twice(simulate: Callable[..., Any]) -> None:
    def node() -> Node:
        gone = Node("gone")
        gone.destroy_node()
        gone.destroy_node()
        assert gone.handle.destroyed
        return Node("here")

    simulate(node, duration=0.1)


def test_log_levels_and_rosout_as_ros_arguments_say(simulate: Callable[..., Any]) -> None:
    def node(name: str, *words: str) -> Callable[[], Node]:
        def make() -> Node:
            made = Node(name, cli_args=["--ros-args", *words])
            made.get_logger().debug(f"debug of {name}")
            made.get_logger().info(f"info of {name}")
            made.get_logger().get_child("part").debug(f"debug of a part of {name}")
            return made

        return make

    run = simulate(
        node("plain"),
        node("wordy", "--log-level", "debug"),
        node("other"),
        node("named", "--log-level", "named.part:=debug", "--log-level", "warn"),
        node("silent", "--disable-rosout-logs"),
        node("again", "--disable-rosout-logs", "--enable-rosout-logs"),
        duration=0.1,
    )
    assert run.logs() == [
        "info of plain",
        "debug of wordy",
        "info of wordy",
        "debug of a part of wordy",
        "info of other",
        "debug of a part of named",
        "info of again",
    ]


def test_a_name_is_free_again_when_nobody_is_at_work_under_it(simulate: Callable[..., Any]) -> None:
    from rsltrace import NodeSpec

    seen: list[str] = []

    def program() -> None:
        contexts = [rclpy.Context() for _ in range(2)]
        for context in contexts:
            rclpy.init(context=context)
        Node("left", context=contexts[0])  # nobody spins it
        left = Node("left", context=contexts[1])
        executor = rclpy.executors.SingleThreadedExecutor(context=contexts[1])
        executor.add_node(left)
        executor.spin_once(timeout_sec=0.1)
        assert Node("left", context=contexts[0]).handle.number == 2
        contexts[1].try_shutdown()
        seen.append(Node("left", context=contexts[0]).get_fully_qualified_name())

    result = simulate(NodeSpec(main=program), duration=1).result
    assert "several nodes are named /left" in result.notes
    assert seen == ["/left"]
