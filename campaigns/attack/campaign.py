"""Trying cases, counting what came of them, keeping what gave way."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import islice
from pathlib import Path

from campaigns.attack import execution, oracle
from campaigns.attack.corpus import Corpus
from campaigns.attack.families import Family
from campaigns.attack.known import item_of
from campaigns.attack.model import Case, Complaint, Ran, Verdict, Wrong

_ENDS = {0: "answer", 1: "answer", 2: "named error", 3: "named error"}


def try_or_tell(family: Family, seed: int, work: Path, corpus: Corpus, kept: Path) -> Verdict:
    """Try a case; if the attack itself fails, say so and go on."""
    try:
        return try_case(family, seed, work, corpus, kept)
    except Exception:
        told = (Complaint(Wrong.BROKEN, traceback.format_exc()[-1500:]),)
        return Verdict(family.name, family.attack_of(seed), seed, (), told, 0.0, 0.0, 0.0, 0.0)


def try_case(family: Family, seed: int, work: Path, corpus: Corpus, kept: Path) -> Verdict:
    """Make the case of a seed, run and judge it; keep its files if something was wrong."""
    with tempfile.TemporaryDirectory(prefix=f"{family.name}-", dir=work) as name:
        folder = Path(name).resolve() / "case"
        folder.mkdir()
        case = family.case(seed, folder, corpus)
        began = time.monotonic()
        runs: list[Ran] = []
        try:
            if not case.skipped:
                for command in case.commands:
                    runs.append(execution.run(command, Path(name) / "streams"))
                complaints = oracle.judge(case, runs)
            else:
                complaints = []
        finally:
            for clean in case.cleanup:
                clean()
        verdict = Verdict(
            family.name,
            family.attack_of(seed),
            seed,
            tuple(_outcome(ran) for ran in runs),
            tuple(complaints),
            sum(ran.cpu_s for ran in runs),
            max((ran.cpu_s for ran in runs), default=0.0),
            max((ran.rss_mib for ran in runs), default=0.0),
            time.monotonic() - began,
            case.skipped,
            case.note,
        )
        if verdict.complaints:
            _keep(case, runs, verdict, kept)
    return verdict


def _outcome(ran: Ran) -> str:
    if ran.timed_out:
        return "hung"
    if ran.status < 0:
        return "killed" if ran.killed else "died"
    if ran.command.words and ran.command.words[0] == "diff" and ran.status == 3:
        return "answer"
    if ran.status in oracle.INTERRUPTED:
        return "interrupted"
    return _ENDS.get(ran.status, "own status")


def _keep(case: Case, runs: list[Ran], verdict: Verdict, kept: Path) -> None:
    place = kept / f"{verdict.family}-{verdict.attack}-{verdict.seed}"
    shutil.rmtree(place, ignore_errors=True)
    with contextlib.suppress(OSError, shutil.Error):  # pipes and devices stay behind
        shutil.copytree(case.folder, place, symlinks=True, ignore=_too_much)
    place.mkdir(parents=True, exist_ok=True)
    lines = [verdict.reproducer, case.note, ""]
    for complaint in verdict.complaints:
        lines += [f"{complaint.wrong.value}: {complaint.text}", f"    {complaint.command}", ""]
    for ran in runs:
        lines += [f"$ {ran.line}", f"status {ran.status}, {ran.cpu_s:.2f} s, {ran.rss_mib:.0f} MiB"]
        lines += [repr(ran.stdout[-1500:]), repr(ran.stderr[-3000:]), ""]
    (place / "report.txt").write_text("\n".join(lines), encoding="utf-8", errors="replace")


def _too_much(folder: str, names: list[str]) -> set[str]:
    return {name for name in names if not _small_file(Path(folder, name))}


def _small_file(path: Path) -> bool:
    if path.is_dir() and not path.is_symlink():
        return not path.is_mount()
    return path.is_symlink() or (path.is_file() and path.stat().st_size < 64 << 20)


class Tally:
    """What a campaign came to so far, as lines of JSON and as a table."""

    def __init__(self) -> None:
        self.verdicts: list[Verdict] = []

    def add(self, verdict: Verdict) -> None:
        """Count a case."""
        self.verdicts.append(verdict)

    @property
    def found(self) -> Counter[str]:
        """How often each kind of complaint came up."""
        return Counter(key for verdict in self.verdicts for key in verdict.keys)

    def unknown(self) -> list[Verdict]:
        """Return the cases with a complaint that no known failure covers."""
        return [verdict for verdict in self.verdicts if new_of(verdict)]

    def table(self) -> str:
        """Return the figures as Markdown, a row for each family."""
        rows = [
            "| family | cases | commands | answers | named errors | other ends | gave way | known "
            "| CPU s | slowest s | peak MiB |",
            "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
        ]
        groups: dict[str, list[Verdict]] = defaultdict(list)
        for verdict in self.verdicts:
            groups[verdict.family].append(verdict)
        for name, own in [*groups.items(), ("all", self.verdicts)]:
            rows.append(_row(name, own))
        return "\n".join(rows) + "\n"


def new_of(verdict: Verdict) -> frozenset[str]:
    """Return those of a case's complaints that are not known."""
    return frozenset(key for key in verdict.keys if not item_of(key))


def _row(name: str, verdicts: Iterable[Verdict]) -> str:
    own = list(verdicts)
    ends = Counter(outcome for verdict in own for outcome in verdict.outcomes)
    new = sum(1 for verdict in own if new_of(verdict))
    known = sum(1 for verdict in own if verdict.keys and not new_of(verdict))
    other = sum(ends.values()) - ends["answer"] - ends["named error"]
    cells = (
        name,
        len(own),
        sum(ends.values()),
        ends["answer"],
        ends["named error"],
        other,
        new,
        known,
        f"{sum(v.cpu_s for v in own):.0f}",
        f"{max((v.cpu_s_max for v in own), default=0):.1f}",
        f"{max((v.rss_mib_max for v in own), default=0):.0f}",
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def as_json(verdict: Verdict) -> str:
    """Return a case's line of JSON."""
    value = asdict(verdict)
    value["complaints"] = [
        {"wrong": c.wrong.value, "text": c.text, "command": c.command} for c in verdict.complaints
    ]
    value["known"] = sorted(verdict.keys - new_of(verdict))
    value["reproducer"] = verdict.reproducer
    return json.dumps(value)


def from_json(line: str) -> Verdict:
    """Read a line of JSON again."""
    value = json.loads(line)
    del value["known"], value["reproducer"]
    value["complaints"] = tuple(
        Complaint(Wrong(c["wrong"]), c["text"], c["command"]) for c in value["complaints"]
    )
    value["outcomes"] = tuple(value["outcomes"])
    return Verdict(**value)


def slice_of(families: Iterable[Family], every: int = 1) -> Iterator[tuple[Family, int]]:
    """Yield each attack that does not wait, a few seeds of it; of those one in ``every``."""
    for family in families:
        seeds = range(family.rounds * len(family.attacks))
        for seed in islice(filter(family.in_slice, seeds), None, None, every):
            yield family, seed
