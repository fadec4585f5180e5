"""Golden traces that are cut, damaged, foreign or no files: the pytest plugin passes none of them.

Each case is a team's folder with one test per golden trace, and one run of its pytest.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from xml.etree import ElementTree

from campaigns.attack.corpus import Corpus
from campaigns.attack.execution import call
from campaigns.attack.families.common import Attack, Family
from campaigns.attack.families.trace_case import flip
from campaigns.attack.model import Case, Command, Complaint, Limits, Ran, Wrong
from campaigns.attack.reading import content

_TESTS = """\
import pathlib
import pytest
NAMES = {names!r}
@pytest.mark.parametrize("name", NAMES)
def test_robot(name, rsltrace_golden):
    rsltrace_golden("run.mcap", "golden/" + name)
"""
_OURS = re.compile(r"(?:^|[\s/])rsltrace/[\w/]+\.py:\d+")
_LIMITS = Limits(cpu_s=30, rss_mib=600)

Make = Callable[[Random, Corpus, Path, bytes], bool]
"""Puts a golden trace at a place, for a run of these bytes; returns whether it may pass."""


def _healthy(rng: Random, corpus: Corpus, place: Path, run: bytes) -> bool:
    place.write_bytes(run)
    return True


def _cut(rng: Random, corpus: Corpus, place: Path, run: bytes) -> bool:
    place.write_bytes(run[: rng.choice((rng.randrange(len(run)), len(run) - rng.randrange(1, 99)))])
    return False


def _flipped(rng: Random, corpus: Corpus, place: Path, run: bytes) -> bool:
    place.write_bytes(flip(rng, run, rng.choice((1, 5, 100))))
    return True  # where nobody has to read, or what is for people alone


def _zeroed(rng: Random, corpus: Corpus, place: Path, run: bytes) -> bool:
    size = rng.choice((64, 4096))
    at = rng.randrange(len(run) - size)
    place.write_bytes(run[:at] + bytes(size) + run[at + size :])
    return True


def _foreign(rng: Random, corpus: Corpus, place: Path, run: bytes) -> bool:
    place.write_bytes(rng.choice([one for one in corpus.traces if one != run]))
    return False


def _noise(rng: Random, corpus: Corpus, place: Path, run: bytes) -> bool:
    place.write_bytes(rng.choice((b"", b"rubbish", rng.randbytes(5000), run[:8], b"nodes: []\n")))
    return False


def _missing(rng: Random, corpus: Corpus, place: Path, run: bytes) -> bool:
    if rng.random() < 0.5:
        place.symlink_to("nowhere.mcap")
    return False


def _no_file(rng: Random, corpus: Corpus, place: Path, run: bytes) -> bool:
    kind = rng.choice(("pipe", "folder", "device", "loop"))
    if kind == "pipe":
        os.mkfifo(place)
    elif kind == "folder":
        place.mkdir()
    elif kind == "device":
        place.symlink_to("/dev/zero")
    else:
        place.symlink_to(place.name)
    return False


_MAKERS: dict[str, Make] = {
    "healthy": _healthy,
    "cut": _cut,
    "flipped": _flipped,
    "zeroed": _zeroed,
    "foreign": _foreign,
    "noise": _noise,
    "missing": _missing,
    "no-file": _no_file,
}


def _compared(rng: Random, case: Case, corpus: Corpus) -> None:
    """Each golden trace is one thing or another; the run is healthy."""
    run = rng.choice(corpus.traces)
    chosen = list(_MAKERS) + rng.choices(list(_MAKERS), k=6)
    _team(rng, case, corpus, chosen, run, run)


def _cut_run(rng: Random, case: Case, corpus: Corpus) -> None:
    """The run was killed: nothing passes, not even the same bytes."""
    whole = rng.choice(corpus.traces)
    run = whole[: rng.randrange(len(whole))]
    _team(rng, case, corpus, ["healthy", "cut", "foreign", "flipped"], run, whole, broken=True)


def _updated(rng: Random, case: Case, corpus: Corpus) -> None:
    """``--rsltrace-update``: afterwards the golden trace is the run, or what it was before."""
    run = rng.choice(corpus.traces)
    chosen = list(_MAKERS) + rng.choices(list(_MAKERS), k=3)
    broken = rng.random() < 0.4
    given = run[: rng.randrange(len(run))] if broken else run
    _team(rng, case, corpus, chosen, given, run, broken=broken, update=True)


def _updated_on_a_full_disk(rng: Random, case: Case, corpus: Corpus) -> None:
    run = corpus.robot
    chosen = ["foreign", "noise", "cut", "missing"]
    limits = Limits(cpu_s=30, rss_mib=600, file_bytes=len(run) - rng.randrange(1, len(run) // 2))
    _team(rng, case, corpus, chosen, run, run, update=True, limits=limits)


def _team(
    rng: Random,
    case: Case,
    corpus: Corpus,
    chosen: Sequence[str],
    run: bytes,
    whole: bytes,
    *,
    broken: bool = False,
    update: bool = False,
    limits: Limits = _LIMITS,
) -> None:
    folder = case.folder
    (folder / "golden").mkdir()
    (folder / "run.mcap").write_bytes(run)
    may_pass = {}
    for number, kind in enumerate(chosen):
        name = f"{number}-{kind}.mcap"
        may_pass[name] = _MAKERS[kind](rng, corpus, folder / "golden" / name, whole) and not broken
    if broken:
        may_pass["same.mcap"] = False
        (folder / "golden" / "same.mcap").write_bytes(run)
    names = sorted(may_pass)
    (folder / "test_robot.py").write_text(_TESTS.format(names=names))
    before = {name: _bytes(folder / "golden" / name) for name in names}
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    words += ["--junitxml=report.xml", *(["--rsltrace-update"] if update else [])]
    case.commands.append(
        Command(
            ("pytest",),
            frozenset((0, 1)),
            folder,
            program=tuple(words),
            limits=limits,
            environment=(("PYTEST_ADDOPTS", ""), ("PYTHONDONTWRITEBYTECODE", "1")),
        )
    )
    case.user_code = True
    judge = _judge_update if update else _judge
    case.judge = lambda runs: judge(case, runs, may_pass, before)


def _judge(
    case: Case, runs: Sequence[Ran], may_pass: dict[str, bool], before: dict[str, bytes | None]
) -> list[Complaint]:
    found: list[Complaint] = []
    results = _results(case, runs, found)
    for name, failure in results.items():
        passes = may_pass.get(name, False) and _same(case, name)
        if not failure and not passes:
            found.append(Complaint(Wrong.ANSWER, f"{name} passes", "pytest"))
        if failure and "healthy" in name and passes:
            found.append(Complaint(Wrong.ANSWER, f"{name} fails: {failure[:300]}", "pytest"))
        if _bytes(case.folder / "golden" / name) != before.get(name):
            found.append(Complaint(Wrong.LOST, f"{name} was changed without being asked", "pytest"))
    return found


def _judge_update(
    case: Case, runs: Sequence[Ran], may_pass: dict[str, bool], before: dict[str, bytes | None]
) -> list[Complaint]:
    found: list[Complaint] = []
    run = (case.folder / "run.mcap").read_bytes()
    for name, failure in _results(case, runs, found).items():
        now = _bytes(case.folder / "golden" / name)
        if failure and now != before.get(name):
            found.append(Complaint(Wrong.LOST, f"{name} failed, and is another", "pytest"))
        elif not failure and now != run and not (may_pass[name] and _same(case, name)):
            found.append(Complaint(Wrong.LOST, f"{name} passed, and is not the run", "pytest"))
    strange = {one.name for one in (case.folder / "golden").iterdir()} - set(before)
    if strange:
        found.append(Complaint(Wrong.LOST, f"left behind: {sorted(strange)}", "pytest"))
    return found


def _results(case: Case, runs: Sequence[Ran], found: list[Complaint]) -> dict[str, str]:
    """Return what each test failed with, by the name of its golden trace; empty if it passed."""
    (ran,) = runs
    text = ran.stdout.decode("utf-8", "replace")
    try:
        tree = ElementTree.parse(case.folder / "report.xml")
    except (OSError, ElementTree.ParseError) as error:
        if ran.timed_out:
            return {}
        found.append(Complaint(Wrong.BROKEN, f"no report: {error}; {text[-300:]}", ran.line))
        return {}
    if (ours := _OURS.search(text)) is not None:
        around = text[max(ours.start() - 300, 0) : ours.end() + 200]
        found.append(Complaint(Wrong.TRACEBACK, around, ran.line))
    results = {}
    for one in tree.iter("testcase"):
        name = str(one.get("name")).partition("[")[2].rstrip("]")
        bad = [part for part in one if part.tag in ("failure", "error")]
        results[name] = "".join(f"{part.get('message')} {part.text}" for part in bad)
        if any(part.tag == "error" for part in bad):
            found.append(Complaint(Wrong.BROKEN, f"{name}: {results[name][:300]}", ran.line))
        elif bad and not _says_which(name, results[name]):
            found.append(Complaint(Wrong.UNNAMED, f"{name}: {results[name][:300]}", ran.line))
    if not results:
        found.append(Complaint(Wrong.BROKEN, f"no test ran: {text[-300:]}", ran.line))
    return results


def _says_which(name: str, failure: str) -> bool:
    """Whether a failure is about this golden trace, its run, or what differs between them."""
    return name in failure or "run.mcap" in failure or "--rsltrace-update" in failure


def _same(case: Case, name: str) -> bool:
    """Whether a golden trace has the events of the run, as far as the mcap package can tell."""

    def events(place: Path) -> list[object] | None:
        answer = call(lambda: content(place), case.folder / ".scratch")
        found = None if answer is None else json.loads(answer)["events"]
        return found if found is None else list(found)

    told = events(case.folder / "golden" / name)
    return told is None or told == events(case.folder / "run.mcap")


def _bytes(place: Path) -> bytes | None:
    return place.read_bytes() if place.is_file() else None


_ATTACKS: dict[str, Attack] = {
    "compared": _compared,
    "cut-run": _cut_run,
    "updated": _updated,
    "updated-on-a-full-disk": _updated_on_a_full_disk,
}

FAMILY = Family("golden", _ATTACKS, sliced=frozenset(("compared", "updated")))
