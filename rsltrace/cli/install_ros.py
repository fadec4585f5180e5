"""``rsltrace install-ros``: rclpy and messages for machines that ROS has no wheels for."""

from __future__ import annotations

import csv
import importlib.util
import io
import re
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from collections.abc import Iterator
from email.parser import HeaderParser
from pathlib import Path, PurePosixPath

import click

from rsltrace.errors import SetupError
from rsltrace.terminal import say

_RELEASES = ("jazzy", "kilted")
_PACKAGES = ("rclpy", "common-interfaces")
_BUILT_FOR = ("3.12", "manylinux_2_28_x86_64")
"""Python and machine whose wheels are taken; what is compiled in them is left out."""
_PYTHON = re.compile(
    r"(?:[^/]+\.data/(?:purelib|platlib|data/lib/python3\.\d+/site-packages)/)?(?!.*\.data/)"
)
_SHARED = re.compile(
    r"[^/]+\.data/data/(share/(?:ament_index/.*|.*(?:\.(?:msg|srv|action|idl|json|em)|package\.xml)))$"
)
_REQUIRED = re.compile(r"(ros-[a-z0-9-]+)\s*([~=<>!][^;]*)?\s*(;.*extra.*)?$")


@click.command(name="install-ros")
@click.option(
    "--release", type=click.Choice(_RELEASES), default="jazzy", show_default=True, help="Of ROS 2."
)
@click.option(
    "--into",
    type=click.Path(file_okay=False, path_type=Path),
    help="A folder to import from, in place of this environment.",
)
def install_ros(release: str, into: Path | None) -> None:
    """Install rclpy and the common interfaces without ROS's compiled libraries.

    For machines that ROS has no wheels for, such as ARM and macOS, and no installation of ROS 2.
    The Python files and definitions come from the wheels of another machine. With them rsltrace
    records, replays and explores nodes in rclpy, with the same digests. What needs the libraries
    says so: record --native, and nodes in C++.

    pip must reach a package index. `pip uninstall ros-rclpy ...` takes the files away.
    """
    if into is None and importlib.util.find_spec("rclpy") is not None:
        raise SetupError("rclpy is installed for this Python already; --into names another folder")
    packages = into or Path(sysconfig.get_path("purelib"))
    data = into or Path(sysconfig.get_path("data"))
    others: set[str] = set()
    count = 0
    with tempfile.TemporaryDirectory(prefix="rsltrace_ros_") as folder:
        wanted = [f"ros-{release}-{name}" for name in _PACKAGES]
        for wheel in _download(wanted, Path(folder), others):
            count += _unpack(wheel, packages, data)
            say(wheel.name.split("-")[0])
    say(f"wrote {count} files of ROS 2 {release.title()} to {packages}")
    if into is None:
        _pip("install", *sorted(others))
    else:
        say(f"they need {', '.join(sorted(others))}")


def _download(wanted: list[str], folder: Path, others: set[str]) -> Iterator[Path]:
    """Yield the wheels of ``wanted`` and of what they need of ROS; add to ``others`` what else."""
    python, machine = _BUILT_FOR
    seen: set[str] = set()
    while wanted:
        seen.update(_REQUIRED.sub(r"\1", one) for one in wanted)
        before = set(folder.iterdir())
        options = ["--no-deps", "--only-binary=:all:", f"--python-version={python}"]
        _pip("download", *options, f"--platform={machine}", f"--dest={folder}", *wanted)
        wanted = []
        for wheel in sorted(set(folder.iterdir()) - before):
            for requirement in _requirements(wheel):
                found = _REQUIRED.match(requirement)
                if found is None and "extra" not in requirement:
                    others.add(requirement)
                if found and not found[3] and found[1] not in seen:
                    seen.add(found[1])
                    wanted.append(f"{found[1]}{found[2] or ''}".strip())
            yield wheel


def _requirements(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as packed:
        (name,) = [one for one in packed.namelist() if one.endswith(".dist-info/METADATA")]
        text = packed.read(name).decode()
    return HeaderParser().parsestr(text).get_all("Requires-Dist") or []


def _unpack(wheel: Path, packages: Path, data: Path) -> int:
    """Write the Python files and definitions of a wheel, and their list; return how many."""
    written: list[Path] = []
    with zipfile.ZipFile(wheel) as packed:
        for name in packed.namelist():
            target = _place(name, packages, data)
            if target is not None:
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(packed.read(name))
                written.append(target)
        (record,) = [name for name in packed.namelist() if name.endswith(".dist-info/RECORD")]
    listed = io.StringIO()
    rows = csv.writer(listed, lineterminator="\n")
    rows.writerows((target, "", "") for target in [*written, record])  # for pip uninstall
    (packages / record).write_text(listed.getvalue())
    return len(written)


def _place(name: str, packages: Path, data: Path) -> Path | None:
    """Return where a file of a wheel is written, None for what is compiled or for building."""
    if name.endswith("/") or name.startswith("/") or ".." in PurePosixPath(name).parts:
        return None
    shared = _SHARED.match(name)
    if shared:
        return data / shared[1]
    found = _PYTHON.match(name)
    if found is None:
        return None
    path = PurePosixPath(name[found.end() :])
    is_metadata = path.parts[0].endswith((".dist-info", ".egg-info")) and path.name != "RECORD"
    return packages / path if is_metadata or path.suffix in (".py", ".lark", ".em") else None


def _pip(*words: str) -> None:
    """Run pip; raise SetupError with what it says if it fails."""
    command = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", *words]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if "ERROR" in line] or ["it failed"]
        raise SetupError(f"pip {words[0]}: {errors[-1]}")
