"""What is asked of a hostile trace, and what the right answers are."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from random import Random

from campaigns.attack import oracle
from campaigns.attack.execution import call
from campaigns.attack.model import Case, Complaint, Limits, Ran, Wrong
from campaigns.attack.reading import content

HOSTILE = "hostile.mcap"
ORIGINAL = "original.mcap"
FORMATS = ("text", "json", "markdown", "junit", "github", "html")


def attack_trace(
    case: Case,
    rng: Random,
    data: bytes,
    original: bytes,
    *,
    differs: bool = False,
    names: Sequence[str] = (),
) -> None:
    """Have every reader read ``data``, a changed ``original``.

    ``differs``: it is known not to be the same run, whoever can read it or not.
    """
    folder = case.folder
    (folder / HOSTILE).write_bytes(data)
    (folder / ORIGINAL).write_bytes(original)
    case.names = (HOSTILE, "--check needs two traces", *names)
    size_mib = len(data) / (1 << 20)
    limits = Limits(cpu_s=8 + 4 * size_mib, rss_mib=600 + int(20 * size_mib))
    sides = [ORIGINAL, HOSTILE] if rng.random() < 0.7 else [HOSTILE, ORIGINAL]
    reading = [
        ("info", HOSTILE),
        ("info", HOSTILE, "--check", "--json"),
        ("cat", HOSTILE),
        ("cat", HOSTILE, "--json", "--payloads"),
        ("export", HOSTILE, "-o", "bag", "--force"),
        ("export", HOSTILE, "--perfetto", "p.pftrace", "--layout", "layout.json", "--force"),
        ("diff", *sides),
        ("diff", *sides, "--check", "--format", rng.choice(FORMATS)),
        ("diff", HOSTILE, HOSTILE, "--all"),
    ]
    if rng.random() < 0.25:
        reading.append(("diff", *sides, "--all", "--abs", "*=1e-3"))
    if rng.random() < 0.2:
        reading.append(("view", HOSTILE, "--export", "screen.txt"))
    case.commands += [oracle.reading(*words, cwd=folder, limits=limits) for words in reading]
    case.judge = lambda runs: _judge(case, runs, differs=differs)


def _judge(case: Case, runs: Sequence[Ran], *, differs: bool) -> list[Complaint]:
    found: list[Complaint] = []
    known: dict[str, dict[str, object] | None] = {}

    def said(name: str) -> dict[str, object] | None:
        if name not in known:
            answer = call(lambda: content(case.folder / name), case.folder / ".scratch")
            known[name] = None if answer is None else json.loads(answer)
        return known[name]

    for ran in runs:
        words = ran.command.words
        if words[0] == "diff" and ran.status == oracle.OK and ORIGINAL in words:
            found += _judge_identical(ran, said(HOSTILE), said(ORIGINAL), differs=differs)
        elif words[0] == "cat" and "--json" in words and ran.status == oracle.OK:
            found += _judge_rows(ran, said(HOSTILE), said(ORIGINAL))
    return found


def _judge_identical(
    ran: Ran,
    hostile: dict[str, object] | None,
    original: dict[str, object] | None,
    *,
    differs: bool,
) -> list[Complaint]:
    wrong = Wrong.ANSWER
    if differs:
        text = "called identical, though it is cut or another run"
    elif "--check" not in ran.command.words:
        # It answers from the chain hashes, and reads no messages: docs/trust.md says so.
        return []
    elif hostile is not None and original is not None and hostile != original:
        text = "called identical, though its messages are others"
        wrong = Wrong.FORGED
    elif hostile is None:
        text = "called identical with --check, though the mcap package refuses the file"
        wrong = Wrong.FORGED
    else:
        return []
    return [Complaint(wrong, text, ran.line)]


def _judge_rows(
    ran: Ran, hostile: dict[str, object] | None, original: dict[str, object] | None
) -> list[Complaint]:
    """Events that are told must be those of the file, or of what it was made of."""
    try:
        lines = [json.loads(line) for line in ran.stdout.splitlines()]
        keys = ("index", "stamp_ns", "entity", "input_hash", "output_hash")
        told = [[line[key] for key in keys] for line in lines]
    except (ValueError, KeyError, TypeError) as error:
        return [Complaint(Wrong.ANSWER, f"not the JSON of events: {error}", ran.line)]
    for reading in (original, hostile):
        if reading is None:
            continue
        events = reading["events"]
        assert isinstance(events, list)
        if told == events[: len(told)]:
            return []
    if hostile is None:
        return []  # nobody else can tell
    return [Complaint(Wrong.ANSWER, "tells events that are not in the file", ran.line)]


def flip(rng: Random, data: bytes, count: int, low: int = 0, high: int | None = None) -> bytes:
    """Return ``data`` with bits flipped in so many bytes."""
    changed = bytearray(data)
    for _ in range(count):
        at = rng.randrange(low, high or len(changed))
        changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed)


def place_of(case: Case, name: str) -> Path:
    """Return a file of the case."""
    return case.folder / name
