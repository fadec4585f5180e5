"""A picture of a recording as the viewer shows it, without a screen: for documents and tests.

Rerun's headless viewer needs a Vulkan driver; Mesa's software rasterizer (Debian:
``mesa-vulkan-drivers``) is one that works anywhere.

    python -m rsltrace_viewer.rerun_export.picture run.rrd run.png sim_time 12.5
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from rsltrace_viewer.rerun_export.columns import EVENT
from rsltrace_viewer.rerun_export.control import LOADED_S_MAX, controlled

_SOFTWARE_DRIVER = Path("/usr/share/vulkan/icd.d/lvp_icd.x86_64.json")
WINDOW = "1600x1000"
_SETTLE_S = 1.0
_GREETING_S = 6.0
"""How long the viewer shows that it runs headless."""
_COLOURS = 256


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
        viewer.seek(timeline, int(value if timeline == EVENT else value * 1e9))
        time.sleep(settle_s)
        viewer.client.save_screenshot(str(picture.absolute()))
        return [
            f"{view.name}: {report.summary} {report.details or ''}".rstrip()
            for view in viewer.client.get_state().views
            for report in view.reports
        ]


def shrink(picture: Path) -> None:
    """Make a PNG several times smaller, for a repository: with few colours."""
    from PIL import Image  # Rerun brings it

    with Image.open(picture) as image:
        small = image.convert("RGB").quantize(_COLOURS, method=Image.Quantize.MEDIANCUT)
    small.save(picture, optimize=True)


if __name__ == "__main__":
    source, target, on_timeline, at = sys.argv[1:5]
    for line in take(Path(source), Path(target), on_timeline, float(at), settle_s=_GREETING_S):
        print(line)
    shrink(Path(target))
