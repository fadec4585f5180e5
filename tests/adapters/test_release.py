"""Releases of ROS 2: how their rclpy differs, and that one that rsltrace does not know is refused
before anything runs."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rsltrace.adapters.rclpy.boundary.installation as installing
from rsltrace.adapters.rclpy.boundary.boundary import RclpyBoundary
from rsltrace.adapters.rclpy.boundary.installation import boundary, missing_parts
from rsltrace.adapters.rclpy.handles.timers import TimerHandle
from rsltrace.adapters.rclpy.messages import interfaces
from rsltrace.diff import diff_files
from rsltrace.errors import SetupError, UnsupportedError
from rsltrace.run import provenance

pytestmark = pytest.mark.ros


def test_a_missing_part_of_the_boundary_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    boundary()  # this release is complete
    monkeypatch.setattr(installing, "_installed", None)
    monkeypatch.delattr(RclpyBoundary, "rclpy_get_topic_names_and_types")
    monkeypatch.delattr(TimerHandle, "time_since_last_call")
    with pytest.raises(SetupError) as caught:
        boundary()
    text = str(caught.value)
    assert "it uses Timer.time_since_last_call, rclpy_get_topic_names_and_types of" in text
    assert "Humble (rclpy 3.3), Jazzy (7.1) and Kilted (9.1)" in text
    assert installing._installed is None


_SOURCE = """
x: '_rclpy.OnlyForTypeCheckers'
y: list['_rclpy.Too']  # and not _rclpy.in_a_comment
_rclpy.teleport(1)
_rclpy.known()
handle.beam(2)
"""
_STUB = """
class Destroyable: ...

class Timer(Destroyable):
    def __init__(self) -> None: ...
    def beam(self, far: int) -> None: ...
    def unused(self) -> None: ...
"""


class Timer:
    def beam(self) -> None: ...
    def unused(self) -> None: ...


@pytest.mark.parametrize("loaded", [True, False])
def test_only_what_rclpy_uses_and_has_is_missed(loaded: bool, tmp_path: Path) -> None:
    for name, text in (("new.py", _SOURCE), ("impl/_rclpy_pybind11.pyi", _STUB)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    real = SimpleNamespace(teleport=1, known=2, unused=3, Timer=Timer) if loaded else None
    ours = SimpleNamespace(known=2, real=real)
    assert missing_parts(ours, {"Timer": object}, tmp_path) == ["Timer.beam", "teleport"]
    ours = SimpleNamespace(known=2, teleport=3, real=real)
    assert missing_parts(ours, {"Timer": Timer}, tmp_path) == []


@pytest.fixture
def like_humble(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Change what Humble's rclpy and messages have otherwise: callbacks of subscriptions are plain
    attributes, modules do not import ``time``, nothing has a type hash."""
    import rclpy.node
    from rclpy.subscription import Subscription
    from rclpy.topic_endpoint_info import TopicEndpointInfo

    def create(self: Any, handle: Any, *arguments: Any, **options: Any) -> None:
        real(self, handle, *arguments, **options)
        for name in ("_callback", "_callback_type"):
            vars(self).pop(name, None)

    real = Subscription.__init__
    monkeypatch.delattr(Subscription, "callback")
    monkeypatch.setattr(Subscription, "__init__", create)
    monkeypatch.delattr(rclpy.node, "time")
    nothing = SimpleNamespace(destroy=lambda: None)
    monkeypatch.setattr(rclpy.node, "TypeDescriptionService", lambda node: nothing)
    monkeypatch.delattr(TopicEndpointInfo, "topic_type_hash")
    monkeypatch.setattr(interfaces, "installed_type_hash", lambda name: None)
    versions = {"rclpy": "3.3.15", "python": "3.10.13"}
    monkeypatch.setattr(provenance, "_versions", lambda: tuple(versions.items()))
    caches = (interfaces.type_hash, interfaces.message_type, interfaces.service_type)
    for cached in caches:
        cached.cache_clear()
    yield
    for cached in caches:
        cached.cache_clear()


def test_a_package_on_humble_and_on_this_release(
    simulate: Any, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    from rclpy.node import Node
    from rosgraph_msgs.msg import Clock

    endpoints: list[set[str]] = []

    class Both(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("both")
            publisher = self.create_publisher(Clock, "stamps", 10)
            self.create_subscription(Clock, "stamps", self.read, 10)
            self.create_timer(1.0, lambda: publisher.publish(Clock()))

        def read(self, message: Clock) -> None:
            found = boundary().rclpy_get_publishers_info_by_topic(self.handle, "/stamps", False)
            endpoints.append(set(found[0]))

    here = tmp_path / "here.mcap"
    shutil.copy(simulate(Both, duration=1).path, here)
    request.getfixturevalue("like_humble")
    there = simulate(Both, duration=1)
    assert endpoints[0] - endpoints[1] == {"topic_type_hash"}
    assert b"RIHS01" in here.read_bytes()
    assert b"RIHS01" not in there.path.read_bytes()
    settings = diff_files(there.path, here).settings
    assert [(one.name, one.a) for one in settings][:2] == [
        ("python", "3.10.13"),
        ("rclpy", "3.3.15 (humble)"),
    ]


def test_qos_events_have_the_name_that_they_had_up_to_humble() -> None:
    from rsltrace.adapters.rclpy.handles.entity_handle import EVENTS

    assert RclpyBoundary.QoSEvent is RclpyBoundary.EventHandle
    assert "_QoSEventHandler__event" in EVENTS


def test_nodes_on_asyncio_are_refused_by_name(simulate: Any, tmp_path: Path) -> None:
    from rclpy.node import Node
    from std_msgs.msg import Empty

    class Listener(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("listener")
            handle = self.create_subscription(Empty, "x", print, 1).handle
            with pytest.raises(UnsupportedError, match=r"AsyncNode .* cannot be simulated yet"):
                handle.set_on_new_message_callback(print)

    simulate(Listener, duration=0)
    module = tmp_path / "experimental" / "async_node.py"
    module.parent.mkdir()
    module.write_text("_rclpy.unknown()")
    assert missing_parts(SimpleNamespace(), {}, tmp_path) == []


def test_a_free_threaded_python_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installing, "_installed", None)
    monkeypatch.setattr(sys, "abiflags", "t")
    with pytest.raises(SetupError, match="free-threaded build of Python"):
        boundary()
