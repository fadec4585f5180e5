"""The packages under ``tests/demos``: installing them, and running them natively over DDS.

They are ordinary ROS packages (``ament_python``: package.xml, setup.py, entry points) that know
nothing of rsltrace. Natively each program is a process; what it logs is what it did.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

DEMOS = Path(__file__).parents[1] / "demos"
SERVERS = ("talker", "thermostat", "adder", "fibonacci_server", "camera")
"""Programs that run until they are stopped."""
CLIENTS = (
    "listener",
    "thermostat_tuner",
    "asker",
    "blocking_asker",
    "fibonacci_client",
    "camera_manager",
)
CENSUS = ("census", *SERVERS)
"""Writes down who of the servers offers what."""

_LINE = re.compile(r"^\|(?P<name>[\w.]+)\|(?P<text>.*)$")
_START = """
import sys
from importlib.metadata import entry_points
name = sys.argv[0] = sys.argv[1]
del sys.argv[1]
(program,) = entry_points(group="console_scripts", name=name)
sys.exit(program.load()())
"""


def install_demos(target: Path) -> Path:
    """Install the packages as colcon would, into ``target``; return the prefix."""
    sources = target / "src"
    shutil.copytree(DEMOS, sources, ignore=shutil.ignore_patterns("__pycache__"))
    packages = sorted(str(path.parent) for path in sources.glob("*/setup.py"))
    prefix = target / "prefix"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-build-isolation"]
    command += ["--no-deps", "--no-index", "--disable-pip-version-check", "--target", str(prefix)]
    done = subprocess.run([*command, *packages], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return prefix


def package_of(program: str) -> str:
    """Return the package of one of the programs."""
    (path,) = DEMOS.glob(f"*/*/{program}.py")
    return path.parent.name


class Native:
    """A graph of programs over DDS."""

    def __init__(self, prefix: Path, folder: Path) -> None:
        self._folder = folder
        folder.mkdir()
        path = os.pathsep.join([str(prefix), *filter(None, [os.environ.get("PYTHONPATH")])])
        self._environment = {
            **os.environ,
            "PYTHONPATH": path,
            "PYTHONUNBUFFERED": "1",
            "RCUTILS_CONSOLE_OUTPUT_FORMAT": "|{name}|{message}",
            "RCUTILS_COLORIZED_OUTPUT": "0",
            "ROS_LOG_DIR": str(folder / "log"),
        }
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Native:
        return self

    def __exit__(self, *exc: object) -> None:
        for process in self._running.values():
            process.kill()
            process.wait()

    def start(self, program: str, *arguments: str) -> None:
        """Start a program."""
        with (self._folder / f"{program}.txt").open("wb") as output:
            self._running[program] = subprocess.Popen(
                [sys.executable, "-c", _START, program, *arguments],
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def wait(self, program: str, seconds: float) -> None:
        """Wait for a program to end by itself."""
        status = self._running.pop(program).wait(seconds)
        assert status == 0, f"{program} ended with {status}:\n{self.output(program)}"

    def stop(self, program: str) -> None:
        """End a program as Ctrl-C does."""
        self._running[program].send_signal(signal.SIGINT)
        self.wait(program, 600)

    def output(self, program: str) -> str:
        """Return what a program has printed."""
        return (self._folder / f"{program}.txt").read_text()


def run_natively(prefix: Path, folder: Path) -> dict[str, list[str]]:
    """Run all programs over DDS; return what each node logged."""
    logs: defaultdict[str, list[str]] = defaultdict(list)
    with Native(prefix, folder) as native:
        for program in SERVERS:
            native.start(program)
        native.start(*CENSUS)
        native.wait("census", 600)
        for program in CLIENTS:
            native.start(program)
        deadline = time.monotonic() + 600
        for program in CLIENTS:
            native.wait(program, max(deadline - time.monotonic(), 1))
        for program in SERVERS:
            native.stop(program)
        for program in (*SERVERS, *CLIENTS, "census"):
            for line in native.output(program).splitlines():
                match = _LINE.match(line)
                assert match, f"{program} printed {line!r}"
                logs[match["name"]].append(match["text"])
    return dict(logs)
