"""``rsltrace install-ros``: what is not compiled of ROS's wheels, unpacked."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from click.testing import CliRunner

from rsltrace.cli import install_ros
from rsltrace.cli.main import cli

PROJECT = Path(__file__).parents[2]
_HERE = "data/lib/python3.12/site-packages"


def _wheel(folder: Path, name: str, files: dict[str, str], *requires: str) -> None:
    """Write a wheel as ROS's are made: nearly all of it is in its data."""
    info = f"{name}-1.0.dist-info"
    lines = "".join(f"Requires-Dist: {one}\n" for one in requires)
    with zipfile.ZipFile(folder / f"{name}-1.0-cp312-cp312-manylinux_2_28_x86_64.whl", "w") as made:
        made.writestr(f"{name}-1.0.data/data/lib/python3.12/site-packages/", "")
        for path, text in files.items():
            made.writestr(f"{name}-1.0.data/{path}", text)
        made.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\n{lines}\nText.\n")
        made.writestr(f"{info}/RECORD", "")


def test_what_is_not_compiled_is_unpacked_with_what_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def pip(*words: str) -> None:
        (folder,) = [Path(one.partition("=")[2]) for one in words if one.startswith("--dest=")]
        names = [one for one in words[1:] if not one.startswith("-")]
        asked.append(names)
        for name in names:
            if name == "ros-jazzy-rclpy":
                needs = ("ros-rclpy==1.0", "ros-rmw; extra == 'fastrtps'", "pyyaml")
                _wheel(folder, "ros_jazzy_rclpy", {}, *needs)
            elif name == "ros-jazzy-common-interfaces":
                _wheel(folder, "ros_jazzy_common_interfaces", {}, "ros-rclpy==1.0")
            else:
                files = {
                    f"{_HERE}/rclpy/__init__.py": "x = 1\n",
                    f"{_HERE}/rclpy/_rclpy.cpython-312-x86_64-linux-gnu.so": "",
                    f"{_HERE}/../../../evil.py": "",
                    "data/lib/librcl.so": "",
                    "data/include/rcl/rcl.h": "",
                    "data/share/std_msgs/msg/Bool.json": "{}",
                }
                _wheel(folder, "ros_rclpy", files)

    monkeypatch.setattr(install_ros, "_pip", pip)
    target = tmp_path / "target"
    done = CliRunner().invoke(cli, ["install-ros", "--into", str(target)])
    assert done.exit_code == 0, done.output
    assert asked == [["ros-jazzy-rclpy", "ros-jazzy-common-interfaces"], ["ros-rclpy==1.0"]]
    assert "they need pyyaml" in done.output
    found = {str(path.relative_to(target)) for path in target.rglob("*") if path.is_file()}
    assert {one for one in found if "dist-info" not in one} == {
        "rclpy/__init__.py",
        "share/std_msgs/msg/Bool.json",
    }
    listed = (target / "ros_rclpy-1.0.dist-info" / "RECORD").read_text().splitlines()
    assert f"{target}/rclpy/__init__.py,," in listed


def test_it_does_not_replace_rclpy_and_says_what_pip_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    done = CliRunner().invoke(cli, ["install-ros"])
    assert done.exit_code != 0
    assert "rclpy is installed for this Python already" in done.output + done.stderr
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    done = CliRunner().invoke(cli, ["install-ros", "--into", str(tmp_path / "target")])
    assert "pip download: ERROR: No matching distribution found" in done.output + done.stderr
    assert not (tmp_path / "target").exists()


@pytest.mark.long
def test_a_run_without_any_of_ros_libraries_is_the_same(tmp_path: Path) -> None:
    """The files of the wheels that are installed here, without what is compiled."""
    distributions = _ros_files()
    if not distributions:
        pytest.skip("ROS is not installed as wheels")
    for path, source in distributions:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).symlink_to(source)
    hidden = tmp_path / "sitecustomize.py"
    packages = sorted({path.parts[0] for path, _ in distributions})
    hidden.write_text(
        "import sys\n"
        f"_names, _place = {packages!r}, {str(tmp_path)!r}\n"
        "from importlib.machinery import PathFinder\n"
        "class First:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name in _names:\n"
        "            return PathFinder.find_spec(name, [_place])\n"
        "sys.meta_path.insert(0, First())\n"
    )
    runs = []
    for path in ("", str(tmp_path)):
        command = [sys.executable, "-m", "rsltrace", "record", "examples/cart/job.yaml"]
        done = subprocess.run(
            [*command, "-o", str(tmp_path / "run.mcap"), "--force"],
            cwd=PROJECT,
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        runs.append([line for line in done.stdout.splitlines() if line.startswith("digest")])
    assert runs[0] == runs[1] != []


def _ros_files() -> list[tuple[Path, Path]]:
    from importlib import metadata

    found: list[tuple[Path, Path]] = []
    for one in metadata.distributions():
        if str(one.metadata["Name"]).startswith("ros-"):
            for path in one.files or ():
                source = Path(str(one.locate_file(path)))
                if path.suffix == ".py" and ".." not in path.parts and source.is_file():
                    found.append((Path(path), source.resolve()))
    return found
