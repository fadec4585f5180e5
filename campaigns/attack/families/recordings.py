"""What every recording owes: said to be written means there, whole, and what was printed of it."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence

from campaigns.attack import execution, oracle
from campaigns.attack.model import Case, Complaint, Ran, Wrong

OUTPUT = "out.mcap"
UNFINISHED = "out.unfinished.mcap"
_BESIDE = f"wrote {UNFINISHED} ({OUTPUT} is as it was)"
_DIGEST = re.compile(r"^digest ([0-9a-f]{16})  events (\d+)", re.MULTILINE)
_TOLD = re.compile(r"^digest\s+([0-9a-f]{16})$", re.MULTILINE)
_EVENTS = re.compile(r"^events\s+(\d+)", re.MULTILINE)


def fingerprint(case: Case) -> str:
    """Return what the old output is known by."""
    place = case.folder / OUTPUT
    return hashlib.sha256(place.read_bytes()).hexdigest() if place.exists() else ""


def judge(
    case: Case,
    runs: Sequence[Ran],
    *,
    old: str = "",
    tampers: bool = False,
    must_fail: bool = False,
    whole_if: frozenset[int] = frozenset(),
) -> list[Complaint]:
    """Judge the last of ``runs``, a recording to ``out.mcap``.

    ``old`` is the fingerprint of the file that ``--force`` replaces. ``tampers``: the nodes
    themselves hurt the file, so it may be lost, but not said to be there. ``whole_if``: besides 0,
    exit statuses after which the file has its end.
    """
    (ran,) = [one for one in runs if one.command.words[:1] == ("record",)][-1:]
    if ran.timed_out:
        return []
    line = ran.line
    place = case.folder / OUTPUT
    found: list[Complaint] = []
    if ran.status == oracle.OK or ran.status in whole_if:
        beside = _BESIDE in ran.stderr.decode(errors="replace")
        found += _judge_whole(case, ran, UNFINISHED if beside else OUTPUT)
        if beside and fingerprint(case) != old:
            found.append(Complaint(Wrong.LOST, "said to be as it was, and is not", line))
    if must_fail and ran.status == oracle.OK:
        found.append(Complaint(Wrong.LOST, "ended well although its output was taken away", line))
    if tampers or ran.status == oracle.OK:
        return found
    if not place.exists():
        if old:
            found.append(Complaint(Wrong.LOST, "--force: the old trace is gone, no new one", line))
        return found
    if old and fingerprint(case) == old:
        return found
    told = _ask(case, "info", OUTPUT)
    if told.status != oracle.OK:
        text = f"what is left cannot be read: {told.stderr.decode(errors='replace')[-300:]}"
        found.append(Complaint(Wrong.LOST, ("--force: " if old else "") + text, line))
    elif old and (match := _EVENTS.search(told.stdout.decode())) and match[1] == "0":
        found.append(
            Complaint(Wrong.LOST, "--force: the old trace gave way to one of 0 events", line)
        )
    return found


def _judge_whole(case: Case, ran: Ran, output: str) -> list[Complaint]:
    place = case.folder / output
    if not place.exists():
        return [Complaint(Wrong.LOST, f"status {ran.status}, and there is no trace", ran.line)]
    checked = _ask(case, "info", output, "--check")
    text = checked.stdout.decode("utf-8", "replace")
    if checked.status != oracle.OK:
        error = checked.stderr.decode(errors="replace")[-300:]
        return [Complaint(Wrong.LOST, f"status {ran.status}, but: {error}", ran.line)]
    found = []
    if "cut off" in text:
        found.append(Complaint(Wrong.LOST, f"status {ran.status}, but the file is cut", ran.line))
    said = _DIGEST.search(ran.stdout.decode("utf-8", "replace"))
    told = _TOLD.search(text)
    if said and told and said[1] != told[1]:
        found.append(Complaint(Wrong.LOST, f"printed {said[1]}, in the file {told[1]}", ran.line))
    return found


def _ask(case: Case, *words: str) -> Ran:
    command = oracle.reading(*words, cwd=case.folder)
    return execution.run(command, case.folder.parent / "asked")
