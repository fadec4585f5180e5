"""A picture of a recording as the viewer shows it, without a screen: for documents and tests.

Rerun's headless viewer needs a Vulkan driver; Mesa's software rasterizer (Debian:
``mesa-vulkan-drivers``) is one that works anywhere.

    python -m rsltrace_viewer.rerun_export.picture run.rrd run.png sim_time 12.5
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from rsltrace.errors import SetupError
from rsltrace_viewer.rerun_export.columns import EVENT
from rsltrace_viewer.rerun_export.sdk import require, viewer

_SOFTWARE_DRIVER = Path("/usr/share/vulkan/icd.d/lvp_icd.x86_64.json")
LOOPBACK = "127.0.0.1"
WINDOW = "1600x1000"
_SETTLE_S = 1.0
_GREETING_S = 6.0
"""How long the viewer shows that it runs headless."""
_COLOURS = 256
_LOADED_S_MAX = 20.0


def software_driver() -> Path | None:
    """Return where the software rasterizer is described, or None if it is not installed."""
    return _SOFTWARE_DRIVER if _SOFTWARE_DRIVER.exists() else None


def take(
    recording: Path, picture: Path, timeline: str, value: float, *, settle_s: float = _SETTLE_S
) -> list[str]:
    """Write a PNG of ``recording`` with the cursor at a time (seconds) or event number.

    Returns what views report as wrong, which is nothing for a good recording.
    """
    require()
    from rerun.experimental import ViewerClient

    if not hasattr(ViewerClient, "open"):
        raise SetupError("pictures need Rerun 0.41, and that needs Python 3.11")
    port = _free_port()
    environment = dict(os.environ, RERUN_APP_ONLY="true")
    driver = software_driver()
    if driver is not None:
        environment.setdefault("VK_ICD_FILENAMES", str(driver))
    # Started here and not by ViewerClient.spawn, which would listen on every network interface.
    process = subprocess.Popen(
        [
            *(str(viewer()), "--headless", "--hide-welcome-screen"),
            *("--bind", LOOPBACK, "--port", str(port), "--window-size", WINDOW),
        ],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        _wait_for(port, process)
        client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        client.open(str(recording.absolute()))
        until = time.monotonic() + _LOADED_S_MAX
        while client.get_state().loading and time.monotonic() < until:
            time.sleep(0.1)
        if timeline == EVENT:
            client.set_time(timeline, sequence=int(value), play_state="paused")
        else:
            stamp = np.timedelta64(int(value * 1e9), "ns")
            client.set_time(timeline, duration=stamp, play_state="paused")
        time.sleep(settle_s)
        client.save_screenshot(str(picture.absolute()))
        return [
            f"{view.name}: {report.summary} {report.details or ''}".rstrip()
            for view in client.get_state().views
            for report in view.reports
        ]
    finally:
        process.terminate()
        process.wait()


def _wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    """Wait until the viewer listens. Raises SetupError if it ends or does not come up."""
    until = time.monotonic() + _LOADED_S_MAX
    while time.monotonic() < until and process.poll() is None:
        try:
            socket.create_connection((LOOPBACK, port), timeout=1).close()
            return
        except OSError:
            time.sleep(0.05)
    raise SetupError(
        "Rerun's headless viewer does not start; without a graphics driver it needs a software "
        "one (Debian: apt install mesa-vulkan-drivers)"
    )


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


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
