"""What is mutated: sample traces, a recorded robot in several segments, and bags made of it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROBOT = HERE / "robot"
REPOSITORY = HERE.parents[1]
SAMPLES = REPOSITORY / "sample_traces"
PAIRS = ("delayed_input", "missing_event", "nondeterministic_callback", "schedule")


class CorpusError(Exception):
    """The attack cannot begin: healthy work already fails."""


@dataclass(frozen=True)
class Corpus:
    """Healthy files, made once below ``folder`` and never changed."""

    folder: Path

    @cached_property
    def samples(self) -> dict[str, bytes]:
        """The checked-in traces, by pair and side: ``schedule/a``."""
        return {
            f"{pair}/{side}": (SAMPLES / pair / f"{side}.mcap").read_bytes()
            for pair in PAIRS
            for side in "ab"
        }

    @cached_property
    def robot(self) -> bytes:
        """The robot's trace."""
        return self._made("robot.mcap", ["record", str(ROBOT / "job.yaml"), "--quiet"]).read_bytes()

    @cached_property
    def other(self) -> bytes:
        """The trace of the same robot with another period."""
        words = ["record", str(ROBOT / "job.yaml"), "--quiet"]
        words += ["--set", "nodes.0.parameters.period=0.02"]
        return self._made("other.mcap", words).read_bytes()

    @cached_property
    def traces(self) -> list[bytes]:
        """Whole traces, some of one segment and some of several."""
        return [*self.samples.values(), self.robot, self.robot, self.robot, self.other]

    @cached_property
    def bag(self) -> Path:
        """The robot's messages as a bag: metadata.yaml and an MCAP file."""
        trace = self._made("robot.mcap", ["record", str(ROBOT / "job.yaml"), "--quiet"])
        folder = self.folder / "bag"
        if not folder.exists():
            _rsltrace(["export", str(trace), "-o", str(folder)])
        return folder

    @cached_property
    def sqlite_bag(self) -> Path:
        """The same in sqlite3."""
        from rosbags.rosbag2 import Reader, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        folder = self.folder / "sqlite_bag"
        if folder.exists():
            return folder
        store = get_typestore(Stores.ROS2_JAZZY)
        sqlite = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
        with Reader(self.bag) as reader, sqlite as writer:
            made = {
                one.id: writer.add_connection(one.topic, one.msgtype, typestore=store)
                for one in reader.connections
                if one.msgtype in store.types
            }
            for one, stamp, data in reader.messages():
                if one.id in made:
                    writer.write(made[one.id], stamp, data)
        return folder

    def _made(self, name: str, words: Sequence[str]) -> Path:
        place = self.folder / name
        if not place.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            _rsltrace([*words, "-o", str(place)])
        return place


def put_robot(folder: Path, *names: str) -> None:
    """Copy the robot (and what else is named of its folder) into a case's folder."""
    for name in ("robot.py", "job.yaml", *names):
        shutil.copy(ROBOT / name, folder / name)


def _rsltrace(words: Sequence[str]) -> None:
    command = [str(Path(sys.executable).with_name("rsltrace")), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode:
        raise CorpusError(f"{' '.join(command)}: exit status {done.returncode}: {done.stderr}")
