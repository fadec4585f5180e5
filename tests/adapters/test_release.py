"""A release of ROS 2 that rsltrace does not know is refused before anything runs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

import rsltrace.adapters.rclpy.boundary.installation as installing
from rsltrace.adapters.rclpy.boundary.boundary import RclpyBoundary
from rsltrace.adapters.rclpy.boundary.installation import boundary, missing_parts
from rsltrace.errors import SetupError

pytestmark = pytest.mark.ros


def test_a_missing_part_of_the_boundary_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    boundary()  # this release is complete
    monkeypatch.setattr(installing, "_installed", None)
    monkeypatch.delattr(RclpyBoundary, "rclpy_get_topic_names_and_types")
    with pytest.raises(SetupError) as caught:
        boundary()
    text = str(caught.value)
    assert "it uses rclpy_get_topic_names_and_types of" in text
    assert "Jazzy (rclpy 7.1) and Kilted (rclpy 9.1)" in text
    assert installing._installed is None


def test_only_what_rclpy_uses_is_missed(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "new.py").write_text(
        "x: '_rclpy.OnlyForTypeCheckers'\ny: list['_rclpy.Too']\n_rclpy.teleport(1)\n"
        "_rclpy.known()\n"
    )
    assert missing_parts(SimpleNamespace(known=2), tmp_path) == ["teleport"]
    assert missing_parts(SimpleNamespace(known=2, teleport=3), tmp_path) == []
