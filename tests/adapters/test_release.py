"""A release of ROS 2 that rsltrace does not know is refused before anything runs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

import rsltrace.adapters.rclpy.boundary.installation as installing
from rsltrace.adapters.rclpy.boundary.boundary import RclpyBoundary
from rsltrace.adapters.rclpy.boundary.installation import boundary, missing_parts
from rsltrace.adapters.rclpy.handles.timers import TimerHandle
from rsltrace.errors import SetupError

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
    assert "Jazzy (rclpy 7.1) and Kilted (rclpy 9.1)" in text
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
