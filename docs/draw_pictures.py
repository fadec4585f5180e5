"""The pictures in ``docs/pictures`` of the viewer and of Rerun: ``make pictures``.

    python docs/draw_pictures.py [NAME]... [--to FOLDER]

The viewer's are drawn from the sample traces and the tutorial's runs, without a screen, and always
with the same bytes. Rerun's is of the Husky job with two settings; it needs the recording (see
``examples/sensor_fusion/README.md``) and a graphics driver: one in software will do (Debian:
mesa-vulkan-drivers). Its bytes vary with the driver, so the PNG says what it was drawn from. A test
fails when a picture is stale.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "pictures"
HUSKY = ROOT.parent / "shared" / "data" / "husky_outdoor"
LIVE = "B slash t o r q u e colon space d a t a space greater_than_sign space 1 enter full_stop"
VIEWS = {
    "view_overview.svg": ("delayed_input", "a.mcap", "--size", "100x22"),
    "view.svg": ("delayed_input", "a.mcap", "--at", "252"),
    "view_two.svg": ("nondeterministic_callback", "a.mcap", "b.mcap"),
    "view_live.svg": ("schedule", "a.mcap", "--live", "--at", "20", "--keys", LIVE),
    "cart_two.svg": ("cart", "good.mcap", "bad.mcap"),
    "view_plot.svg": ("schedule", "a.mcap", "b.mcap", "--light", "--keys", "p"),
}
"""By name: the sample (or the tutorial's cart), and what ``rsltrace view`` is told there."""
CART = {
    "good.mcap": (),
    "bad.mcap": ("--set", 'policy={"departures": [{"choice": 222, "run": 1}]}'),
}
"""The tutorial's runs: its second one is what ``rsltrace explore`` tells there."""
RERUN = "rerun_two.png"
SETTINGS = ((), ("--set", "nodes.EkfNode.parameters.imu_mount=[0.0, 0.0, 0.0]"))
"""How the Husky's two runs differ: the second takes its IMU, which lies on its side, as upright."""
AT_S = 1_432_235_890.0
"""Where the cursor is, in seconds of simulated time: near the end of the drive."""


def draw_view(name: str, folder: Path) -> Path:
    """Draw a picture of the viewer's into ``folder``; return its path."""
    sample, *words = VIEWS[name]
    with tempfile.TemporaryDirectory() as made:
        at = record_cart(Path(made)) if sample == "cart" else ROOT / "sample_traces" / sample
        _rsltrace("view", *words, "--export", str(folder / name), at=at)
    return folder / name


def record_cart(folder: Path) -> Path:
    """Record the tutorial's two runs in a copy of the example; return its folder."""
    at = shutil.copytree(ROOT / "examples" / "cart", folder / "cart")
    for name, settings in CART.items():
        words = ("record", "job.yaml", "-q", "-o", name, *settings)
        _rsltrace(*words, at=at, status=1 if settings else 0)
    return at


def record_husky(folder: Path) -> Path:
    """Record the Husky's drive twice into ``folder``; return a Rerun recording of both."""
    job = ROOT / "examples" / "sensor_fusion" / "job_husky.yaml"
    for name, settings in zip(("a.mcap", "b.mcap"), SETTINGS, strict=True):
        _rsltrace("record", str(job), "-q", "-o", name, *settings, at=folder)
    _rsltrace("rerun", "a.mcap", "b.mcap", "-o", "husky.rrd", at=folder)
    return folder / "husky.rrd"


def draw_rerun(folder: Path) -> Path:
    """Draw the picture of Rerun into ``folder``; return its path."""
    with tempfile.TemporaryDirectory() as made:
        recording = record_husky(Path(made))
        words = str(recording), str(folder / RERUN), "sim_time", str(AT_S)
        _python("-m", "rsltrace_viewer.rerun_export.picture", *words, at=folder)
    return folder / RERUN


def _rsltrace(*words: str, at: Path, status: int = 0) -> None:
    _python("-m", "rsltrace", *words, at=at, status=status)


def _python(*words: str, at: Path, status: int = 0) -> None:
    done = subprocess.run([sys.executable, *words], cwd=at, check=False)
    if done.returncode != status:
        raise SystemExit(f"{' '.join(words)} ended with {done.returncode}")


def main() -> None:
    """Draw what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", default=[*VIEWS, RERUN])
    parser.add_argument("--to", type=Path, default=PICTURES, metavar="FOLDER")
    options = parser.parse_args()
    folder = options.to.resolve()
    for name in options.names:
        if name != RERUN:
            print(draw_view(name, folder))
        elif HUSKY.exists():
            print(draw_rerun(folder))
        else:
            print(f"{RERUN}: left as it is, since {HUSKY} is not there")


if __name__ == "__main__":
    main()
