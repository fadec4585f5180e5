"""One case, or many: plant a fault, record both runs, ask the oracle."""

from __future__ import annotations

import builtins
import importlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from campaigns.truth import faults, recordings
from campaigns.truth.complaint import Complaint
from campaigns.truth.graph import HIDDEN, World
from campaigns.truth.known import item_of
from campaigns.truth.oracle import complaints

_SERVER = """
import socket, sys
server = socket.create_server(("127.0.0.1", int(sys.argv[1])))
print("ready", flush=True)
while True:
    link = server.accept()[0]
    link.recv(4096)
    link.sendall(b"HTTP/1.0 200 OK\\r\\n\\r\\n" + sys.argv[2].encode())
    link.close()
"""


@dataclass(frozen=True)
class Outcome:
    """What became of one planted fault."""

    name: str
    seed: int
    wrong: tuple[Complaint, ...]

    @property
    def reproducer(self) -> str:
        """The line that repeats it."""
        return f"python -m campaigns.truth --only '{self.name}' --seed {self.seed}"

    @property
    def keys(self) -> list[str]:
        """What is wrong, as ``known`` names it."""
        return [f"{self.name}: {complaint.what}" for complaint in self.wrong]

    @property
    def unknown(self) -> list[str]:
        """What is wrong and should not be."""
        return [key for key in self.keys if not item_of(key)]


def try_case(name: str, seed: int, folder: Path) -> Outcome:
    """Plant one fault and check the diff; the traces stay in ``folder``."""
    planted = faults.FAULTS[name](random.Random(f"{name} {seed}"))
    if planted.recordings is not None:
        return Outcome(name, seed, tuple(recordings.complaints(planted.recordings, folder)))
    for world, trace in ((planted.a, "a.mcap"), (planted.b, "b.mcap")):
        _record(world, folder / world.folder, folder / trace)
    wrong = complaints(folder / "a.mcap", folder / "b.mcap", planted.truth)
    return Outcome(name, seed, tuple(wrong))


def _record(world: World, folder: Path, output: Path) -> None:
    from rsltrace import load_job
    from rsltrace.run import run

    job = world.write(folder)
    importlib.invalidate_caches()
    with _surroundings(world, folder):
        run(load_job(job), output, force=True)


@contextmanager
def _surroundings(world: World, folder: Path) -> Iterator[None]:
    """Set what a run finds around it, and no bytecode of an earlier one."""
    kept, written = dict(os.environ), sys.dont_write_bytecode
    os.environ.update(world.environment)
    sys.dont_write_bytecode = True
    setattr(builtins, HIDDEN, world.hidden)
    try:
        with _answering(world), _working_in(folder / world.working_folder):
            yield
    finally:
        delattr(builtins, HIDDEN)
        sys.dont_write_bytecode = written
        os.environ.clear()
        os.environ.update(kept)


@contextmanager
def _answering(world: World) -> Iterator[None]:
    """Run a server that gives one answer to everybody, in a process of its own."""
    if world.answer is None:
        yield
        return
    words = [sys.executable, "-c", _SERVER, *map(str, world.answer)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        server.stdout.readline()
        try:
            yield
        finally:
            server.kill()


@contextmanager
def _working_in(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    folder.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def try_cases(cases: Iterable[tuple[str, int]]) -> Iterator[Outcome]:
    """Try cases one after another."""
    faults.load()
    for name, seed in cases:
        with tempfile.TemporaryDirectory(prefix="rsltrace-truth-") as folder:
            try:
                yield try_case(name, seed, Path(folder))
            except Exception as error:
                text = f"{type(error).__name__}: {error}"
                yield Outcome(name, seed, (Complaint("crash", text),))


def keep_case(name: str, seed: int, folder: Path) -> Outcome:
    """Try one case and keep its files."""
    faults.load()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return try_case(name, seed, folder)


def cases(count: int, first_seed: int = 0) -> list[tuple[str, int]]:
    """Return ``count`` cases, of all classes in turn."""
    faults.load()
    names = list(faults.FAULTS)
    return [
        (names[number % len(names)], first_seed + number // len(names)) for number in range(count)
    ]


def table(outcomes: list[Outcome]) -> str:
    """Return the classes with how many of their cases are right, as Markdown."""
    planted = Counter(outcome.name for outcome in outcomes)
    right = Counter(outcome.name for outcome in outcomes if not outcome.wrong)
    rows = ["| class | planted | right | wrong in |", "|---|---|---|---|"]
    for name in planted:
        what = Counter(
            what for o in outcomes if o.name == name for what in {c.what for c in o.wrong}
        )
        told = ", ".join(f"{word} {count}" for word, count in sorted(what.items()))
        rows.append(f"| {name} | {planted[name]} | {right[name]} | {told} |")
    rows.append(f"| all {len(planted)} | {len(outcomes)} | {right.total()} | |")
    return "\n".join(rows) + "\n"


FAMILIES = {
    "behaviour": "what a callback does",
    "waiting": "what a callback waits for, makes, destroys, fails in",
    "messages": "what is in a message",
    "sensors": "messages of sensors, poses, maps, joints",
    "answers": "answers of sockets, programs and files",
    "actions": "actions: goals, feedback, results, cancelling",
    "lifecycle": "lifecycle nodes",
    "mains": "programs: mains, threads, executors, launch files",
    "timing": "timers and clocks",
    "starts": "nodes that start while others run, or start again",
    "settings": "settings and code",
    "rules": "links, drawn orders, clocks, bags and parameters of the job",
    "delivery": "queues and QoS",
    "bags": "messages of bags that are played",
    "programs": "scripts, processes of their own, jobs of several files",
    "recordings": "recordings beside recordings",
    "graphs": "graphs",
    "systems": "chains, timers at once, calls in callbacks, parameters in flight, latched topics",
    "mixed": "graphs with a bit of everything",
    "outside": "what comes from outside",
    "origins": "where the cause lies: on import, in helpers, in another node",
    "endings": "how runs end",
    "equal": "what changes nothing, alone and beside a fault",
    "pairs": "two faults at once",
    "unrelated": "two faults that have nothing to do with each other",
}
_TWICE = (", in code", ", hidden")


def families(outcomes: list[Outcome]) -> str:
    """Return the families of classes with how many of their cases are right, as Markdown."""
    rows = ["| family | classes | planted | right |", "|---|---|---|---|"]
    for module, title in FAMILIES.items():
        names = [name for name, family in faults.FAMILIES.items() if family == module]
        of_it = [outcome for outcome in outcomes if outcome.name in names]
        short = [name.removesuffix(_TWICE[0]) for name in names if not name.endswith(_TWICE[1])]
        both = ", each in its code and hidden" if len(short) * 2 == len(names) else ""
        right = sum(not outcome.wrong for outcome in of_it)
        listed = "; ".join(short)
        rows.append(f"| {title}{both} | {len(names)}: {listed} | {len(of_it)} | {right} |")
    right = sum(not outcome.wrong for outcome in outcomes)
    rows.append(f"| all | {len(faults.FAMILIES)} | {len(outcomes)} | {right} |")
    return "\n".join(rows) + "\n"
