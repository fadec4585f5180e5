"""Record every one-liner in perturbed environments and judge what it gave.

Each line of ``lines.txt`` is a callback of its own in one node. What a line gives must be the same
in all runs (*held*), or its finding must be in the traces (*reported*). All else is *silent*, as
the lines below ``# limits`` are known to be.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsltrace.search.perturb import (
    HASH_SEED,
    KERNEL,
    LOCALE,
    TIME_ZONE,
    Perturbation,
    perturbation,
    record_perturbed,
)
from rsltrace.trace.reader import Trace

HERE = Path(__file__).parent
LIMITS = "limits"
_MODULE = "one_liners"
_IN_LINE = re.compile(r" in line_(\d+)\b")
_CASE = """

def line_{number}():
    return repr({line})
"""


@dataclass(frozen=True, slots=True)
class Line:
    """A one-liner, and the topic that it belongs to."""

    topic: str
    text: str


@dataclass(frozen=True, slots=True)
class Judged:
    """A line, what it gave in each run, and the sources of its findings."""

    line: Line
    given: tuple[str, ...]
    sources: frozenset[str]

    @property
    def verdict(self) -> str:
        """Whether the line is held, reported or silent."""
        if self.sources:
            return "reported"
        return "held" if len(set(self.given)) == 1 else "silent"


def all_lines() -> list[Line]:
    """Return the table, which lists the lines below the name of their topic."""
    lines, topic = [], ""
    for text in (HERE / "lines.txt").read_text().splitlines():
        if text.startswith("# "):
            topic = text[2:]
        else:
            lines.append(Line(topic, text))
    return lines


def write_job(lines: Sequence[Line], place: Path) -> Path:
    """Write the node of some lines, and a job that runs each of them once; return the job."""
    cases = (_CASE.format(number=n, line=line.text) for n, line in enumerate(lines))
    (place / f"{_MODULE}.py").write_text((HERE / "node.py").read_text() + "".join(cases))
    nodes, stop = [{"node": f"{_MODULE}:Lines"}], {"duration": f"{len(lines) + 10}s"}
    path = place / "job.json"
    path.write_text(json.dumps({"nodes": nodes, "stop": stop}))
    return path


def judge(lines: Sequence[Line], traces: Sequence[Path]) -> list[Judged]:
    """Judge the lines by the traces of some runs."""
    recorded = [_given(path) for path in traces]
    return [
        Judged(
            line,
            tuple(given.get(number, "nothing") for given, _ in recorded),
            frozenset().union(*(found.get(number, ()) for _, found in recorded)),
        )
        for number, line in enumerate(lines)
    ]


def _given(path: Path) -> tuple[dict[int, str], dict[int, set[str]]]:
    """Return what each line gave in one run, and the sources of its findings."""
    given: dict[int, str] = {}
    found: dict[int, set[str]] = {}
    with Trace.open(path) as trace:
        for *_, data in trace.messages("/given"):
            message: Any = trace.decode("/given", data)
            line, text = json.loads(message.data)
            given[line] = text
        for findings in trace.findings.values():
            for one in findings:
                if match := _IN_LINE.search(one.stack):
                    found.setdefault(int(match[1]), set()).add(one.source.value)
    return given, found


def run(
    lines: Sequence[Line], runs: int, folder: Path, *, options: Sequence[str] = ()
) -> list[Judged]:
    """Record the lines ``runs`` times, with more options of ``record``, and judge each."""
    return judge(lines, [_recorded(lines, number, folder, options) for number in range(runs)])


def _recorded(lines: Sequence[Line], number: int, folder: Path, options: Sequence[str]) -> Path:
    place = folder / "job"
    shutil.rmtree(place, ignore_errors=True)  # so that times and inodes of files differ
    place.mkdir()
    job = write_job(lines, place)
    values = dict(perturbation(number).values)
    values.pop(KERNEL, None)
    if "--no-pin" in options:  # what pytest pins itself is the same; the hash seed is not
        values = {**values, LOCALE: "C.UTF-8", TIME_ZONE: "UTC", HASH_SEED: "random"}
    around = Perturbation(number, values)
    with _limits(number):
        done = record_perturbed(around, [str(job), *options], folder, timeout_s=600)
    if not done.digest:
        raise RuntimeError(f"run {number}: {done.failure}\n{done.errors}")
    return done.path


@contextmanager
def _limits(number: int) -> Iterator[None]:
    """Give the processes of a run limits of their own, which ``perturbation`` leaves alone."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    mask = os.umask(0o22 + (number % 2) * 0o5)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft - number, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        os.umask(mask)
