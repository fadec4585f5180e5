"""A picture of a recording as the viewer shows it, without a screen: for documents and tests.

Rerun's headless viewer needs a Vulkan driver; Mesa's software rasterizer (Debian:
``mesa-vulkan-drivers``) is one that works anywhere.

    python -m rsltrace_viewer.rerun_export.picture run.rrd run.png sim_time 12.5
"""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

import xxhash

from rsltrace_viewer.rerun_export.columns import SIM_TIME
from rsltrace_viewer.rerun_export.control import LOADED_S_MAX, controlled

_SOFTWARE_DRIVER = Path("/usr/share/vulkan/icd.d/lvp_icd.x86_64.json")
WINDOW = "1600x1000"
_SETTLE_S = 1.0
_GREETING_S = 6.0
"""How long the viewer shows that it runs headless."""
_COLOURS = 256
_MENU_HEIGHT = 36
_MADE_FROM = "rsltrace recording"
_MADE_UP = ("rerun.controls.", "log_time", "ViewportBlueprint:root_container")
_UUID = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")


def software_driver() -> Path | None:
    """Return where the software rasterizer is described, or None if it is not installed."""
    return _SOFTWARE_DRIVER if _SOFTWARE_DRIVER.exists() else None


def take(
    recording: Path, picture: Path, timeline: str, value: float, *, settle_s: float = _SETTLE_S
) -> list[str]:
    """Write a PNG of ``recording`` with the cursor at a time (seconds) or event number.

    Returns what views report as wrong, which is nothing for a good recording.
    """
    driver = software_driver()
    if driver is not None:
        os.environ.setdefault("VK_ICD_FILENAMES", str(driver))
    with controlled("--headless", "--window-size", WINDOW) as viewer:
        viewer.open(recording)
        until = time.monotonic() + LOADED_S_MAX
        while viewer.client.get_state().loading and time.monotonic() < until:
            time.sleep(0.1)
        viewer.seek(timeline, int(value * 1e9 if timeline == SIM_TIME else value))
        time.sleep(settle_s)
        viewer.client.save_screenshot(str(picture.absolute()))
        return [
            f"{view.name}: {report.summary} {report.details or ''}".rstrip()
            for view in viewer.client.get_state().views
            for report in view.reports
        ]


def shrink(picture: Path, source: str) -> None:
    """Make a PNG several times smaller, for a repository: with few colours, without the viewer's
    menu. ``source`` is written into it."""
    from PIL import Image, PngImagePlugin  # Rerun brings it

    with Image.open(picture) as image:
        below = image.convert("RGB").crop((0, _MENU_HEIGHT, *image.size))
        small = below.quantize(_COLOURS, method=Image.Quantize.MEDIANCUT)
    notes = PngImagePlugin.PngInfo()
    notes.add_text(_MADE_FROM, source)
    small.save(picture, optimize=True, pnginfo=notes)


def made_from(picture: Path) -> str | None:
    """Return the fingerprint of what a picture was drawn from, None if it does not say."""
    from PIL import Image

    with Image.open(picture) as image:
        found = image.info.get(_MADE_FROM)
    return found if isinstance(found, str) else None


def fingerprint(recording: Path) -> str:
    """Return a hash of all that a recording and its layout hold.

    Left out is what Rerun makes up for each export: the ids of rows, views and containers, and
    when it was made.
    """
    from rerun.chunk import RrdReader

    reader = RrdReader(str(recording))
    rows = set()
    for store in (*reader.recordings(), *reader.blueprints()):
        for chunk in reader.stream(store=store):
            batch = chunk.to_record_batch()
            kept = [name for name in batch.schema.names if not name.startswith(_MADE_UP)]
            for row in batch.select(kept).to_pylist():
                rows.add(_UUID.sub("", f"{chunk.entity_path} {row}"))
    text = "\n".join(sorted(rows))
    return f"{xxhash.xxh3_64_intdigest(text.encode()):016x}"


if __name__ == "__main__":
    source, target, on_timeline, at = sys.argv[1:5]
    for line in take(Path(source), Path(target), on_timeline, float(at), settle_s=_GREETING_S):
        print(line)
    shrink(Path(target), fingerprint(Path(source)))
