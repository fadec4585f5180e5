"""Topics: delivery, copies, depth, raw, message info, late joiners, matching."""

from __future__ import annotations

from typing import Any

import pytest
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Float32, String, UInt64

from rsltrace import Trace
from rsltrace.errors import RunError
from rsltrace.trace.model.event import OutputKind

pytestmark = pytest.mark.ros


def test_fan_out_is_in_the_order_of_creation(simulate: Any) -> None:
    seen: list[str] = []

    class Talker(Node):
        def __init__(self) -> None:
            super().__init__("talker")
            publisher = self.create_publisher(UInt64, "numbers", 10)
            self.create_timer(1.0, lambda: publisher.publish(UInt64(data=1)))

    class Listener(Node):
        def __init__(self, label: str) -> None:
            super().__init__(f"listener_{label}")
            self.create_subscription(UInt64, "numbers", lambda m: seen.append(label), 10)

    def many() -> list[Node]:
        return [Listener(label) for label in "bcade"]

    simulate(many, Talker, duration=2)
    assert seen == list("bcade") * 2


def test_each_subscription_gets_its_own_copy_as_from_a_wire(simulate: Any) -> None:
    got: list[Any] = []

    class Both(Node):
        def __init__(self) -> None:
            super().__init__("both")
            self.publisher = self.create_publisher(Float32, "x", 10)
            self.message = Float32(data=0.1)
            self.create_subscription(Float32, "x", self.first, 10)
            self.create_subscription(Float32, "x", got.append, 10)
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            self.publisher.publish(self.message)
            self.message.data = 7.0  # the publication was a snapshot

        def first(self, message: Float32) -> None:
            got.append(message)
            message.data = -1.0  # nobody else sees this

    simulate(Both, duration=1)
    assert got[0] is not got[1]
    assert got[1].data == pytest.approx(0.1, abs=1e-7)
    assert got[1].data != 0.1  # rounded to float32


def test_a_full_queue_drops_its_oldest_message(simulate: Any) -> None:
    seen: list[int] = []

    class Burst(Node):
        def __init__(self, depth: QoSProfile | int) -> None:
            super().__init__("burst")
            self.publisher = self.create_publisher(UInt64, "n", 100)
            self.create_subscription(UInt64, "n", lambda m: seen.append(m.data), depth)
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            for number in range(5):
                self.publisher.publish(UInt64(data=number))

    simulate(lambda: Burst(2), duration=1)
    assert seen == [3, 4]
    seen.clear()
    keep_all = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=1)
    simulate(lambda: Burst(keep_all), duration=1)
    assert seen == [0, 1, 2, 3, 4]


def test_raw_subscriptions_and_raw_publications(simulate: Any) -> None:
    got: list[bytes] = []
    typed: list[str] = []

    class Raw(Node):
        def __init__(self) -> None:
            super().__init__("raw")
            self.publisher = self.create_publisher(String, "s", 10)
            self.create_subscription(String, "s", got.append, 10, raw=True)
            self.create_subscription(String, "s", lambda m: typed.append(m.data), 10)
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            self.publisher.publish(serialize_message(String(data="abc")))

    simulate(Raw, duration=1)
    assert typed == ["abc"]
    assert got == [b"\x00\x01\x00\x00\x04\x00\x00\x00abc\x00"]


def test_raw_bytes_from_another_process_are_padded_to_four(simulate: Any) -> None:
    """As Fast DDS gives them: measured between two processes, and within one."""
    got: list[bytes] = []
    again: list[str] = []

    class Talks(Node):
        def __init__(self) -> None:
            super().__init__("talks")
            self.publisher = self.create_publisher(String, "s", 10)
            self.create_timer(1.0, lambda: self.publisher.publish(String(data="abcd")))

    class Passes(Node):
        def __init__(self) -> None:
            super().__init__("passes")
            publisher = self.create_publisher(String, "t", 10)
            self.create_subscription(String, "s", got.append, 10, raw=True)
            self.create_subscription(String, "s", publisher.publish, 10, raw=True)

    class Hears(Node):
        def __init__(self) -> None:
            super().__init__("hears")
            self.create_subscription(String, "t", lambda m: again.append(m.data), 10)

    recorded = simulate(Talks, Passes, Hears, duration=1)
    assert got == [b"\x00\x01\x00\x00\x05\x00\x00\x00abcd\x00\x00\x00\x00"]
    assert again == ["abcd"]
    with recorded.trace() as trace:
        kept = [bytes(data) for topic in ("/s", "/t") for *_, data in trace.messages(topic)]
    assert kept == [got[0][:-3]] * 2  # canonical

    def both() -> list[Node]:
        return [Talks(), Passes()]

    got.clear()
    simulate(both, duration=1)
    assert got == [kept[0]]


def test_message_info_carries_simulated_stamps(simulate: Any) -> None:
    infos: list[dict[str, Any]] = []

    class Info(Node):
        def __init__(self) -> None:
            super().__init__("info")
            publisher = self.create_publisher(UInt64, "n", 10)
            self.create_subscription(UInt64, "n", lambda m, info: infos.append(info), 10)
            self.create_timer(1.0, lambda: publisher.publish(UInt64()))

    simulate(Info, duration=2)
    assert [i["source_timestamp"] for i in infos] == [1_000_000_000, 2_000_000_000]
    assert [i["publication_sequence_number"] for i in infos] == [1, 2]
    assert set(infos[0]) == {
        "source_timestamp",
        "received_timestamp",
        "publication_sequence_number",
        "reception_sequence_number",
    }


def test_a_late_joiner_gets_what_a_transient_local_publisher_kept(simulate: Any) -> None:
    seen: list[int] = []
    latched = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    class Late(Node):
        def __init__(self) -> None:
            super().__init__("late")
            publisher = self.create_publisher(UInt64, "map", latched)
            for number in range(4):
                publisher.publish(UInt64(data=number))
            self.timer = self.create_timer(1.0, self.join)

        def join(self) -> None:
            self.timer.cancel()
            qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.create_subscription(UInt64, "map", lambda m: seen.append(m.data), qos)
            self.create_subscription(UInt64, "map", lambda m: seen.append(-1), 10)

    simulate(Late, duration=2)
    assert seen == [2, 3]


def test_incompatible_qos_does_not_connect_and_is_reported(simulate: Any) -> None:
    seen: list[Any] = []

    class Mismatch(Node):
        def __init__(self) -> None:
            super().__init__("mismatch")
            best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            publisher = self.create_publisher(UInt64, "n", best_effort)
            self.create_subscription(UInt64, "n", seen.append, 10)
            self.create_timer(1.0, lambda: publisher.publish(UInt64()))

    trace = simulate(Mismatch, duration=2)
    assert seen == []
    texts = trace.logs()
    assert any("incompatible QoS" in text and "RELIABILITY" in text for text in texts)


def test_an_incompatible_policy_has_the_name_that_rclpy_gives_it(simulate: Any) -> None:
    seen: list[Any] = []

    def node() -> Node:
        node = Node("mismatch")
        note = PublisherEventCallbacks(incompatible_qos=lambda e: seen.append(e.last_policy_kind))
        node.create_publisher(UInt64, "n", qos_profile_sensor_data, event_callbacks=note)
        node.create_subscription(UInt64, "n", print, 10)
        return node

    simulate(node, duration=1)
    (policy,) = seen
    assert (policy.name, policy.value) == ("RMW_QOS_POLICY_RELIABILITY", 16)
    assert QoSPolicyKind(policy) is QoSPolicyKind.RELIABILITY


@pytest.mark.parametrize(
    ("data", "error"),
    [(b"", "RMWError"), (b"\0\1\0\0\x05", "RMWError"), (bytearray(9), "TypeError")],
)
def test_what_is_no_serialized_message_fails_as_in_rclpy(
    simulate: Any, data: Any, error: str
) -> None:
    seen: list[str] = []

    def node() -> Node:
        try:
            deserialize_message(data, String)
        except Exception as raised:
            seen.append(type(raised).__name__)
        return Node("reader")

    simulate(node, duration=0.1)
    assert seen == [error]
    with pytest.raises(Exception) as native:
        deserialize_message(data, String)
    assert native.type.__name__ == error


def test_two_types_on_one_topic_name_both_ends(simulate: Any) -> None:
    class Talker(Node):
        def __init__(self) -> None:
            super().__init__("talker")
            self.create_publisher(UInt64, "/chatter", 10)

    class Listener(Node):
        def __init__(self) -> None:
            super().__init__("listener")
            self.create_subscription(String, "/chatter", print, 10)

    with pytest.raises(RunError) as error:
        simulate(Talker, Listener, duration=1)
    for word in ("/chatter", "/talker", "std_msgs/msg/UInt64", "/listener", "std_msgs/msg/String"):
        assert word in str(error.value)


def test_large_messages_and_empty_ones(simulate: Any) -> None:
    sizes: list[int] = []

    class Camera(Node):
        def __init__(self) -> None:
            super().__init__("camera")
            publisher = self.create_publisher(Image, "image", 10)
            self.create_subscription(Image, "image", lambda m: sizes.append(len(m.data)), 10)
            self.create_timer(1.0, lambda: publisher.publish(Image(data=bytes(3_000_000))))
            publisher.publish(Image())

    simulate(Camera, duration=1)
    assert sizes == [0, 3_000_000]


def test_destroyed_endpoints_are_quiet(simulate: Any) -> None:
    seen: list[int] = []

    class Short(Node):
        def __init__(self) -> None:
            super().__init__("short")
            self.publisher = self.create_publisher(UInt64, "n", 10)
            self.subscription = self.create_subscription(UInt64, "n", self.got, 10)
            self.create_timer(1.0, self.tick)
            self.count = 0

        def tick(self) -> None:
            self.count += 1
            self.publisher.publish(UInt64(data=self.count))
            self.publisher.publish(UInt64(data=self.count))

        def got(self, message: UInt64) -> None:
            seen.append(message.data)
            if message.data == 2:
                self.destroy_subscription(self.subscription)

    simulate(Short, duration=4)
    assert seen == [1, 1, 2]


def test_a_topic_may_have_another_type_later(simulate: Any) -> None:
    """Each type has a channel of its own in the trace, and each message is in its type's."""

    class Talker(Node):
        def __init__(self) -> None:
            super().__init__("talker")
            self.publisher = self.create_publisher(String, "x", 10)
            self.create_timer(1.0, self.tick)

        def tick(self) -> None:
            if self.publisher.msg_type is String:
                self.publisher.publish(String(data="first"))
                self.destroy_publisher(self.publisher)
                self.publisher = self.create_publisher(UInt64, "x", 10)
            else:
                self.publisher.publish(UInt64(data=7))

    path = simulate(Talker, duration=2).path
    with Trace.open(path) as trace:
        sent = [
            output
            for index in range(trace.event_count)
            for output in trace.outputs_of(index)
            if output.kind is OutputKind.MESSAGE and trace.entity(output.entity).name == "/x"
        ]
        said = [
            trace.decode(trace.channel_of(output), trace.payload(output)[2]).data for output in sent
        ]
    assert said == ["first", 7]


def test_best_available_sets_no_deadline(simulate: Any) -> None:
    from rclpy.qos import QoSPresetProfiles

    heard: list[int] = []

    class Best(Node):
        def __init__(self) -> None:
            super().__init__("best")
            self.out = self.create_publisher(UInt64, "n", 1)
            best = QoSPresetProfiles.BEST_AVAILABLE.value
            self.create_subscription(UInt64, "n", lambda m: heard.append(m.data), best)
            deadline = self.get_subscriptions_info_by_topic("/n")[0].qos_profile.deadline
            assert str(deadline) == "Infinite"
            self.create_timer(1.0, lambda: self.out.publish(UInt64(data=7)))

    simulate(Best, duration=1)
    assert heard == [7]
