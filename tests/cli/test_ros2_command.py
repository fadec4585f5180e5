"""``ros2 rsltrace …``: found by its entry point, and the same command as ``rsltrace``.

ROS's command line is on no package index, so a stand-in takes its place where it is not installed:
it has what ros2cli promises its extensions (a base class, argparse, ``main`` with its result).
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

STAND_IN = """
import argparse
import sys
from importlib.metadata import entry_points

class CommandExtension:
    NAME = None

    def __init__(self):
        super().__init__()

def main():
    parser = argparse.ArgumentParser()
    subparsers = parser.add_subparsers(dest='command')
    for entry in entry_points(group='ros2cli.command'):
        extension = entry.load()()
        extension.NAME = entry.name
        command = subparsers.add_parser(entry.name, description=extension.__doc__)
        command.set_defaults(extension=extension)
        extension.add_arguments(command, f'ros2 {entry.name}', argv=None)
    args = parser.parse_args()
    return args.extension.main(parser=parser, args=args)
"""


@pytest.fixture
def ros2(tmp_path: Path) -> object:
    """Run ``ros2 …``: the real one if it is installed, else the stand-in."""
    path = [os.environ.get("PYTHONPATH", "")]
    where = "ros2cli.cli"
    if importlib.util.find_spec("ros2cli") is None:
        package = tmp_path / "stand_in" / "ros2cli"
        package.mkdir(parents=True)
        (package / "__init__.py").write_text("")
        (package / "command.py").write_text(STAND_IN)
        path.insert(0, str(tmp_path / "stand_in"))
        where = "ros2cli.command"

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", f"import sys; from {where} import main; sys.exit(main())",
             *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, path))},
            capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip

    return call


def test_the_whole_command_is_there(ros2: object, tmp_path: Path) -> None:
    assert callable(ros2)
    done = ros2("rsltrace", "record", "--help")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Usage: ros2 rsltrace record [OPTIONS]")
    assert "--ros-args" in done.stdout
    assert "rsltrace" in ros2("--help").stdout
    assert "record --help" in ros2("rsltrace", "--help").stdout
    failed = ros2("rsltrace", "info", "none.mcap")
    assert failed.returncode == 2
    assert "none.mcap does not exist" in failed.stderr


@pytest.mark.long
@pytest.mark.ros
def test_ros_arguments_arrive(ros2: object, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")
    assert callable(ros2)
    (tmp_path / "talk.py").write_text(
        "from rclpy.node import Node\n"
        "class Talker(Node):\n"
        "    def __init__(self):\n"
        "        super().__init__('talker')\n"
        "        self.declare_parameter('rate', 1.0)\n"
        "        import os\n"
        "        self.get_logger().info('seed ' + os.environ.get('PYTHONHASHSEED', 'none'))\n"
        "        self.create_timer(1.0 / self.get_parameter('rate').value, lambda: None)\n"
    )
    (tmp_path / "job.yaml").write_text("nodes: [{node: talk:Talker}]\nstop: {duration: 2s}\n")
    slow = ros2("rsltrace", "record", "job.yaml", "-o", "a.mcap")
    fast = ros2("rsltrace", "record", "job.yaml", "-o", "b.mcap", "--ros-args", "-p", "rate:=4.0",
                "--", "--quiet")  # fmt: skip
    assert (slow.returncode, fast.returncode) == (0, 0), fast.stderr
    assert "seed 0" in slow.stderr  # pinned, as rsltrace itself is
    assert int(fast.stdout.split()[3]) - int(slow.stdout.split()[3]) == 6
    same = subprocess.run(
        [sys.executable, "-m", "rsltrace", "record", "job.yaml", "-o", "c.mcap"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert same.stdout == slow.stdout
