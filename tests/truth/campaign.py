"""One case, or many: plant a fault, record both runs, ask the oracle."""

from __future__ import annotations

import builtins
import importlib
import os
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.truth import faults, recordings
from tests.truth.complaint import Complaint
from tests.truth.graph import HIDDEN, World
from tests.truth.known import item_of
from tests.truth.oracle import complaints


@dataclass(frozen=True)
class Outcome:
    """What became of one planted fault."""

    name: str
    seed: int
    wrong: tuple[Complaint, ...]

    @property
    def reproducer(self) -> str:
        """The line that repeats it."""
        return f"python -m tests.truth --only '{self.name}' --seed {self.seed}"

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
    with _surroundings(world):
        run(load_job(job), output, force=True)


@contextmanager
def _surroundings(world: World) -> Iterator[None]:
    """Set what a run finds around it, and no bytecode of an earlier one."""
    kept, written = dict(os.environ), sys.dont_write_bytecode
    os.environ.update(world.environment)
    sys.dont_write_bytecode = True
    setattr(builtins, HIDDEN, world.hidden)
    try:
        yield
    finally:
        delattr(builtins, HIDDEN)
        sys.dont_write_bytecode = written
        os.environ.clear()
        os.environ.update(kept)


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
