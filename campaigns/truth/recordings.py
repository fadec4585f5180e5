"""Is what ``diff`` says of two recordings true? Asked of the files, with the mcap package alone."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from pathlib import Path

from mcap.reader import make_reader

from campaigns.truth.complaint import Complaint
from campaigns.truth.graph import write_bag
from rsltrace import DiffOptions, diff_bags
from rsltrace.diff.report import render
from rsltrace.diff.result import BagDiff

Messages = list[tuple[int, str, float]]
COUNTS = ("equal", "tolerated", "ignored", "differing", "moved", "only_a", "only_b")


@dataclass(frozen=True)
class Recordings:
    """Two recordings and what is true of them.

    ``counts`` are those of ``COUNTS`` that are not 0, of ``topic``; all else is equal. ``first``
    holds for the sentence, ``place`` is the number of the first message concerned, in a or in b.
    """

    a: Messages
    b: Messages
    topic: str
    counts: dict[str, int]
    verdict: str = "different"
    first: tuple[str, ...] = ()
    place: int | None = None
    options: DiffOptions = field(default_factory=DiffOptions)

    @property
    def exit_code(self) -> int:
        return {"equal": 0, "equal-within-tolerance": 3}.get(self.verdict, 1)


def complaints(planted: Recordings, folder: Path) -> list[Complaint]:
    """Write both and return what is wrong with their diff, in either order."""
    paths = folder / "a.mcap", folder / "b.mcap"
    for path, messages in zip(paths, (planted.a, planted.b), strict=True):
        write_bag(path, messages)
    found, mirrored = diff_bags(*paths, planted.options), diff_bags(*paths[::-1], planted.options)
    wrong = list(_said(found, planted))
    of_a, of_b = _read(paths[0]), _read(paths[1])
    wrong += _counts(found, of_a, of_b, planted)
    if planted.place is not None and found.first is not None:
        numbers = [m.index for m in (found.first.a, found.first.b) if m is not None]
        if planted.place not in numbers:
            wrong.append(Complaint("index", f"{numbers} instead of {planted.place}"))
    for diff in (found, mirrored):
        if diff.exit_code != planted.exit_code:
            wrong.append(Complaint("exit code", f"{diff.exit_code}"))
    swapped = {"only_a": "only_b", "only_b": "only_a"}
    for one, other in zip(found.topics, mirrored.topics, strict=True):
        for name in COUNTS:
            if getattr(one, name) != getattr(other, swapped.get(name, name)):
                wrong.append(Complaint("symmetric", f"{one.topic}: {name}"))
    if (found.first is None) != (mirrored.first is None):
        wrong.append(Complaint("symmetric", "first"))
    elif found.first is not None and mirrored.first is not None:
        one, other = found.first, mirrored.first
        if (one.topic, one.after_ns) != (other.topic, other.after_ns):
            wrong.append(Complaint("symmetric", f"{found.sentence} and {mirrored.sentence}"))
    return wrong


def _said(found: BagDiff, planted: Recordings) -> list[Complaint]:
    wrong = []
    if found.verdict.value != planted.verdict:
        wrong.append(Complaint("verdict", f"{found.verdict.value}: {found.sentence}"))
    report = render(found, "text", options=planted.options, width=200)
    if found.sentence not in report.replace("\n", " "):
        wrong.append(Complaint("evidence", f"{found.sentence!r} is not in the report"))
    wrong += [
        Complaint("first line", f"no {pattern!r} in {found.sentence!r}")
        for pattern in planted.first
        if not re.search(pattern, found.sentence)
    ]
    if found.first is not None and found.first.topic != planted.topic:
        wrong.append(Complaint("entity", f"{found.first.topic} instead of {planted.topic}"))
    return wrong


def _counts(
    found: BagDiff, a: dict[str, list[float]], b: dict[str, list[float]], planted: Recordings
) -> list[Complaint]:
    wrong = []
    for topic in found.topics:
        told = {name: getattr(topic, name) for name in COUNTS}
        of_a = told["equal"] + told["tolerated"] + told["ignored"] + told["differing"]
        if of_a + told["moved"] + told["only_a"] != len(a[topic.topic]):
            wrong.append(Complaint("counts", f"{told} of {len(a[topic.topic])} in a"))
        if of_a + told["moved"] + told["only_b"] != len(b[topic.topic]):
            wrong.append(Complaint("counts", f"{told} of {len(b[topic.topic])} in b"))
        true = planted.counts if topic.topic == planted.topic else {}
        others = {name: count for name, count in told.items() if count and name != "equal"}
        if others != true:
            wrong.append(Complaint("counts", f"{topic.topic}: {others} instead of {true}"))
    return wrong


def _read(path: Path) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append(struct.unpack_from("<d", message.data, 4)[0])
    return found
