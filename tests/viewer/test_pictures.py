"""The pictures of the documents are those that ``make pictures`` draws now."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.long

DRAWING: dict[str, Any] = runpy.run_path(
    str(Path(__file__).parents[2] / "docs" / "draw_pictures.py")
)
PICTURES: Path = DRAWING["PICTURES"]


@pytest.mark.ros
@pytest.mark.parametrize("name", DRAWING["VIEWS"])
def test_a_picture_of_the_viewer_is_current(name: str, tmp_path: Path) -> None:
    if "--live" in DRAWING["VIEWS"][name]:
        pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    made: Path = DRAWING["draw_view"](name, tmp_path)
    assert made.read_bytes() == (PICTURES / name).read_bytes(), "run make pictures"


@pytest.mark.ros
@pytest.mark.skipif(not DRAWING["HUSKY"].exists(), reason="the Husky recording is not here")
@pytest.mark.skipif(sys.version_info < (3, 11), reason="needs Rerun 0.41")
def test_the_picture_of_rerun_is_current(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from rsltrace_viewer.rerun_export.picture import fingerprint, made_from

    recording: Path = DRAWING["record_husky"](tmp_path)
    assert fingerprint(recording) == made_from(PICTURES / DRAWING["RERUN"]), "run make pictures"
