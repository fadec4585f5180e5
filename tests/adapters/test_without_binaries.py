"""Recording needs none of ROS's compiled libraries: not rclpy's extension, nor type support."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a Python that has all that this one has, but no compiled library of ROS."""
    prefix = tmp_path_factory.mktemp("pure")
    own = Path(sys.prefix)
    site = Path(sysconfig.get_path("purelib"))
    copy = prefix / site.relative_to(own)
    copy.mkdir(parents=True)
    for entry in site.iterdir():
        compiled = list(entry.glob("*_s__rosidl_typesupport_*.so")) if entry.is_dir() else []
        if compiled or entry.name == "rclpy":
            shutil.copytree(entry, copy / entry.name, ignore=shutil.ignore_patterns("*.so", "*.c"))
        elif not entry.name.startswith(("ros_", "_rsltrace")):
            (copy / entry.name).symlink_to(entry)
    (prefix / "share").symlink_to(own / "share")
    (prefix / "bin").mkdir()
    (prefix / "bin" / "python").symlink_to(Path(sys.executable).resolve())
    shutil.copy(own / "pyvenv.cfg", prefix)
    assert not list((copy / "rclpy").rglob("*.so"))
    return prefix / "bin" / "python"


COMMAND = """
import atexit, sys
from rsltrace.cli.start import main

@atexit.register
def loaded():
    with open("/proc/self/maps") as maps:
        names = {line.split()[-1].rpartition("/")[2] for line in maps}
    print(sorted(n for n in names if n.startswith(("librcl", "librmw", "librosidl", "_rclpy"))))

main()
"""


def output_of(python: Path, *words: str) -> str:
    """Run the command; return what it prints, and what it has loaded of ROS."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    command = [str(python), "-c", COMMAND, *words]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return run.stdout + run.stderr


@pytest.mark.parametrize(
    "job", ["ping_pong", pytest.param("sensor_fusion", marks=pytest.mark.long)]
)
def test_a_run_needs_no_library_of_ros(python: Path, tmp_path: Path, job: str) -> None:
    words = ["record", f"{REPOSITORY}/examples/{job}/job.yaml", "--until", "1", "-o"]
    pure = output_of(python, *words, f"{tmp_path}/pure.mcap")
    assert pure.startswith("digest ")
    assert "\n[]\n" in pure
    usual = output_of(Path(sys.executable), *words, f"{tmp_path}/usual.mcap")
    assert usual.replace("usual.mcap", "pure.mcap") == pure


@pytest.mark.long
def test_a_native_run_says_what_it_needs(python: Path, tmp_path: Path) -> None:
    job = f"{REPOSITORY}/examples/ping_pong/job.yaml"
    said = output_of(python, "record", job, "--native", "-o", f"{tmp_path}/native.mcap")
    assert "a native run needs the compiled parts of ROS 2, which are not installed" in said
