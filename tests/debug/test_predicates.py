"""Conditions asked by an engine, with messages and log records in the form of a trace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import pytest

from rsltrace.debug.conditions.names import Names
from rsltrace.debug.predicates import compiled, loaded_fields
from rsltrace.errors import ConditionError
from rsltrace.model.event import EventKind, OutputKind
from rsltrace.model.finding import Finding, Mode, Source

pytestmark = pytest.mark.ros


@dataclass
class SeenOutput:
    kind: OutputKind
    name: str
    hash: str
    type: str = ""
    data: bytes | str | None = None


@dataclass
class View:
    index: int = 3
    is_next: bool = False
    now_ns: int = 0
    kind: EventKind = EventKind.TIMER
    entity_id: int = 4
    entity: str = "Driver.drive"
    node: str = "/driver"
    message: Any = None
    output_hash: int = 0xABCD << 48
    outputs: Sequence[SeenOutput] = ()
    findings: Sequence[Finding] = ()
    there: Mapping[str, object] = field(default_factory=dict)

    def nodes(self) -> Mapping[str, object]:
        return self.there


def serialized(message: Any) -> bytes:
    from rsltrace.doors.rclpy.wire.codec import codec_for

    return codec_for(type(message)).serialize(message)


def hit(text: str, view: View) -> str:
    predicate = compiled(text)
    predicate.begin(view)
    assert predicate(view) == bool(predicate.why)
    return predicate.why


def test_messages_are_decoded_from_what_was_sent() -> None:
    from geometry_msgs.msg import Twist, Vector3

    data = serialized(Twist(linear=Vector3(x=0.75)))
    out = SeenOutput(OutputKind.MESSAGE, "/cmd_vel", "00" * 8, "geometry_msgs/msg/Twist", data)
    view = View(outputs=[out])
    assert hit("/cmd_vel: linear.x > 0.7", view).startswith("/driver has published on /cmd_vel")
    assert not hit("/cmd_vel: linear.x > 0.8", view)
    view.is_next = True
    assert not hit("/cmd_vel: linear.x > 0.7", view), "it has not run yet"


def test_logs_exceptions_hashes_and_findings() -> None:
    from rcl_interfaces.msg import Log

    log = serialized(Log(level=30, name="driver", msg="too far: 3 m"))
    raised = "Traceback (most recent call last):\n  File x\nValueError: too far"
    view = View(
        outputs=[
            SeenOutput(OutputKind.LOG, "/rosout", "11" * 8, "rcl_interfaces/msg/Log", log),
            SeenOutput(OutputKind.EXCEPTION, "", "22" * 8, "", raised),
            SeenOutput(OutputKind.MESSAGE, "/hash_only", "33" * 8, "std_msgs/msg/Int64", None),
        ],
        findings=[Finding(3, 4, "/driver", Source.CLOCK, Mode.WARN, "time.time()", "1.5", "")],
    )
    assert hit("log warn too far", view) == "log 'too far: 3 m'"
    assert not hit("log error", view)
    assert hit("exception ValueError", view) == "raised ValueError: too far"
    assert hit("output abcd", view)
    assert hit("output 2222", view)
    assert hit("finding clock", view)
    assert not hit("/hash_only: data > 1", view), "it is known by its hash alone"


def test_fields_are_those_of_loaded_classes() -> None:
    for package in ("geometry_msgs", "nav_msgs"):
        import_module(f"{package}.msg")
    names = Names(
        topics=("/odom",),
        are_all=True,
        interfaces={"/odom": "nav_msgs/msg/Odometry"},
        fields=loaded_fields,
    )
    compiled("/odom: pose.pose.position.x > 3 and pose.covariance[0] > 1", names)
    for text in ("/odom: pose.pose.position.w > 3", "/odom: pose.position.x > 3"):
        with pytest.raises(ConditionError, match="has no field"):
            compiled(text, names)
    assert loaded_fields("no_such_msgs/msg/Thing") is None
