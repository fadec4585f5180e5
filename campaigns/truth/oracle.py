"""Is what ``diff`` says of two runs true? Asked of the traces themselves and of what is planted."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from campaigns.truth import traces
from campaigns.truth.complaint import Complaint
from campaigns.truth.faults.planting import Truth
from rsltrace import Diff, diff
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report import render
from rsltrace.diff.result import Divergence

_MIRRORED = {
    "missing": "extra",
    "extra": "missing",
    "ended-early": "ran-longer",
    "ran-longer": "ended-early",
}
_SAME_WORDS = {"earlier": "later", "fewer": "more", "a": "", "b": ""}


def complaints(a: Path, b: Path, truth: Truth) -> list[Complaint]:
    """Return what is wrong with the diff of two traces, in either order."""
    found, mirrored = diff(a, b), diff(b, a)
    of_a, of_b = traces.read(a), traces.read(b)
    first = traces.first_difference(of_a, of_b)
    wrong = list(_verdict(found, first, truth))
    if truth.exit_code is not None and found.exit_code != truth.exit_code:
        wrong.append(Complaint("exit code", f"{found.exit_code}"))
    if first is None or not found.divergences:
        return wrong
    wrong += _entity(found.divergences[0], of_a, of_b, first, truth)
    wrong += _words(found, truth)
    if truth.values:
        wrong += _values(found, of_a, of_b, truth.values)
    if truth.independent == 1:
        wrong += _reaches(found.divergences[0], of_a, of_b)
    wrong += _symmetric(found, mirrored)
    return wrong


def cause_line(found: Diff) -> str:
    """Return first line and cause."""
    return f"{found.sentence} | {found.divergences[0].root_sentence}"


def _verdict(found: Diff, first: int | None, truth: Truth) -> list[Complaint]:
    wrong = []
    if truth.equal != (first is None):
        wrong.append(Complaint("the fault itself", f"first difference at {first}"))
    if found.identical != (first is None):
        wrong.append(Complaint("verdict", found.sentence))
    if first is not None and found.agreeing != first:
        wrong.append(Complaint("index", f"{found.agreeing} instead of {first}"))
    if truth.verdicts and found.verdict.value not in truth.verdicts:
        wrong.append(Complaint("verdict", f"{found.verdict.value} instead of {truth.verdicts}"))
    if truth.independent is not None and len(found.divergences) > truth.independent:
        others = [other.sentence for other in found.divergences[truth.independent :]]
        wrong.append(Complaint("independent", f"{others}"))
    return wrong


def _entity(
    found: Divergence, a: traces.Recorded, b: traces.Recorded, first: int, truth: Truth
) -> list[Complaint]:
    named = [view.entity for view in (found.a, found.b) if view is not None]
    wrong = []
    for key in named:
        node = key.name if key.kind == "node" else key.node
        if truth.node and node != truth.node:
            wrong.append(Complaint("entity", f"node {node} instead of {truth.node}"))
        if truth.entity and key.name != truth.entity:
            wrong.append(Complaint("entity", f"{key.name} instead of {truth.entity}"))
    there = [run.events[first] for run in (a, b) if first < len(run.events)]
    earliest = min(event.stamp_ns for event in there)
    leading = min((v.stamp_ns for v in (found.a, found.b) if v is not None), default=None)
    ended = found.verdict.value in ("ended-early", "ran-longer")
    if not ended and (leading is None or leading > earliest):
        wrong.append(Complaint("earliest", f"leads with {leading}, first is at {earliest}"))
    return wrong


def _words(found: Diff, truth: Truth) -> list[Complaint]:
    cause = cause_line(found)
    report = render(found, "text", options=DiffOptions(everything=True), width=200)
    wrong = [
        Complaint("first line", f"no {pattern!r} in {found.sentence!r}")
        for pattern in truth.first
        if not re.search(pattern, found.sentence)
    ]
    wrong += [
        Complaint("cause", f"no {pattern!r} in {cause!r}")
        for pattern in truth.says
        if not re.search(pattern, cause)
    ]
    wrong += [
        Complaint("blame", f"{pattern!r} in {cause!r}")
        for pattern in truth.never
        if re.search(pattern, cause)
    ]
    wrong += [
        Complaint("evidence", f"no {pattern!r} in the report")
        for pattern in truth.shows
        if not re.search(pattern, report)
    ]
    return wrong


def _values(found: Diff, a: traces.Recorded, b: traces.Recorded, topic: str) -> list[Complaint]:
    pairs = zip(a.messages.get(topic, []), b.messages.get(topic, []), strict=False)
    one, other = next((x[1], y[1]) for x, y in pairs if x[1] != y[1])
    text = f"data {traces.number(one)!r} → {traces.number(other)!r}"
    if text not in found.sentence:
        return [Complaint("values", f"no {text!r} in {found.sentence!r}")]
    return []


def _reaches(found: Divergence, a: traces.Recorded, b: traces.Recorded) -> list[Complaint]:
    """Compare the topics that a divergence reaches with those that differ in the traces.

    What one run would have published had it not ended is nothing that a divergence reaches.
    """
    end = min(int(run.result["end_time"]) for run in (a, b))
    there = {t: stamp for t, stamp in traces.first_messages(a, b).items() if stamp < end}
    begins = min((view.stamp_ns for view in (found.a, found.b) if view is not None), default=0)
    told = {reach.topic: begins + reach.after_ns for reach in found.reaches}
    wrong = []
    for topic, stamp in told.items():
        if topic.startswith("/") and topic in there and there[topic] != stamp:
            wrong.append(Complaint("reach", f"{topic} at {stamp}, first differs at {there[topic]}"))
    missing = sorted(set(there) - set(told) - {"/parameter_events", "/rosout"})
    if missing:
        wrong.append(Complaint("reach", f"{', '.join(missing)} not told, only {sorted(told)}"))
    return wrong


def _symmetric(found: Diff, mirrored: Diff) -> list[Complaint]:
    wrong = []
    pairs = {
        "index": (found.agreeing, mirrored.agreeing),
        "verdict": (_mirror(found.verdict.value), mirrored.verdict.value),
        "divergences": (len(found.divergences), len(mirrored.divergences)),
        "sentence": (_bag_of_words(found.sentence), _bag_of_words(mirrored.sentence)),
    }
    if found.divergences and mirrored.divergences:
        one, other = found.divergences[0], mirrored.divergences[0]
        pairs["cause"] = (_bag_of_words(one.root_sentence), _bag_of_words(other.root_sentence))
        pairs["root"] = (_mirror(one.root.value), other.root.value)
        pairs["reaches"] = (_reached(one), _reached(other))
        pairs["messages"] = (
            sorted((m.topic, m.position < 0) for m in one.messages),
            sorted((m.topic, m.position < 0) for m in other.messages),
        )
    for what, (one_way, other_way) in pairs.items():
        if one_way != other_way:
            told = (one_way, other_way)
            if what == "sentence":
                told = (found.sentence, mirrored.sentence)
            if what == "cause":
                told = (found.divergences[0].root_sentence, mirrored.divergences[0].root_sentence)
            wrong.append(Complaint("symmetric", f"{what}: {told[0]} and {told[1]}"))
    return wrong


def _reached(found: Divergence) -> list[tuple[str, int, int]]:
    return [(reach.topic, reach.after_ns, abs(reach.moved_ns)) for reach in found.reaches]


def _mirror(word: str) -> str:
    return _MIRRORED.get(word, word)


def _bag_of_words(text: str) -> Counter[str]:
    text = re.sub(r"\bjob\.yaml:\d+", "job.yaml", text)  # its line in one of the two
    found = (word.strip(".:") for word in re.findall(r"[\w./:'-]+", text.lower()))
    words = (_SAME_WORDS.get(word, word) for word in found)
    return Counter(word for word in words if word)
