"""What a person sees: the viewer draws the recordings, and no view has anything to complain of."""

from __future__ import annotations

import struct
import sys
import zlib
from pathlib import Path

import pytest
import rerun_gallery as gallery

pytest.importorskip("rerun")

from rsltrace_viewer.rerun_export import picture
from rsltrace_viewer.rerun_export.export import export

pytestmark = [
    pytest.mark.native,
    pytest.mark.skipif(sys.version_info < (3, 11), reason="needs Rerun 0.41"),
    pytest.mark.skipif(
        picture.software_driver() is None,
        reason="needs a Vulkan driver (Debian: mesa-vulkan-drivers)",
    ),
]


def colours(png: Path) -> int:
    """Return how many different bytes and filters an 8-bit PNG has: a blank one has few."""
    data = png.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    packed, offset = b"", 8
    while offset < len(data):
        (length,) = struct.unpack_from(">I", data, offset)
        if data[offset + 4 : offset + 8] == b"IDAT":
            packed += data[offset + 8 : offset + 8 + length]
        offset += length + 12
    return len(set(zlib.decompress(packed)))


def take(recording: Path, timeline: str, value: float) -> None:
    """Have the viewer draw a recording; a busy machine takes long to draw anything at all."""
    png = recording.with_suffix(".png")
    for settle_s in (1.0, 10.0, 100.0):
        assert picture.take(recording, png, timeline, value, settle_s=settle_s) == []
        if colours(png) > 50:
            return
    pytest.fail("nothing is drawn")


def test_one_run(tmp_path: Path) -> None:
    gallery.write_gallery(tmp_path / "run.mcap", 40)
    export([tmp_path / "run.mcap"], tmp_path / "run.rrd")
    take(tmp_path / "run.rrd", "sim_time", 7.5)


def test_two_runs(tmp_path: Path) -> None:
    gallery.write_gallery(tmp_path / "a.mcap", 40)
    gallery.write_gallery(tmp_path / "b.mcap", 40, differs_from=20)
    export([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "ab.rrd")
    take(tmp_path / "ab.rrd", "row", 60)
