"""The calls the guard found that can explain a divergence: in the event itself, or before it."""

from __future__ import annotations

import re
from itertools import zip_longest
from operator import itemgetter

from rsltrace.diff.alignment.rows import Run
from rsltrace.diff.causes.answers import STARTED_BY, answer_text
from rsltrace.diff.causes.event_views import node_of, subject_of
from rsltrace.diff.causes.module_code import used_by
from rsltrace.diff.result.divergence import CallDifference
from rsltrace.diff.result.events import EventView
from rsltrace.model.entity import EntityKind
from rsltrace.model.finding import Finding, Mode, Source
from rsltrace.model.printable import printable, shortened

CALLS_MAX = 20
EARLIER_MAX = 3
_CALL_MAX = 60
_ANSWERED = (Source.SOCKET, Source.PROCESS)
_FOLDER = re.compile(r"(['\"])/[^'\"]*/(?=[^'\"/]*\1)")
"""The folder of an absolute path between quotes."""

_Numbered = tuple[int, int, Finding]
"""A finding with its event, and its number among those of its run."""


def call_differences(
    run_a: Run, run_b: Run, a: EventView | None, b: EventView | None
) -> tuple[CallDifference, ...]:
    """Return the calls made inside two events, those with different answers first.

    If all answers agree, the first calls before them in the same node, or when its modules were
    imported, that gave different ones come first: what was read earlier may show only now.
    """
    inside = _paired(_inside(run_a, a), _inside(run_b, b))
    differing = [call for call in inside if call.a != call.b]
    if differing:
        return (*differing, *(call for call in inside if call.a == call.b))[:CALLS_MAX]
    some = a or b
    is_somebodys = some is not None and subject_of(some)
    # Where one run has no such event: up to there the two agree, indexes and all.
    before = _paired(_before(run_a, a or b), _before(run_b, b or a)) if is_somebodys else []
    earlier = [call for call in before if call.a != call.b][:EARLIER_MAX]
    places = {call.where for call in earlier}
    programs = [c for c in before if c.call.startswith(STARTED_BY) and c.where in places]
    programs = [call for call in programs if call not in earlier][:EARLIER_MAX]
    return (*earlier, *programs, *inside)[:CALLS_MAX]


def unrecorded_call(run: Run, view: EventView) -> tuple[str, str] | None:
    """Say which answer of a socket or a program nobody kept, and what keeps it: the last one in an
    event, else the last one before it in its node; None if there was none."""
    found = [*_before(run, view), *_inside(run, view)]
    kept = (f for f in reversed(found) if f.source in _ANSWERED and f.mode is Mode.WARN)
    one = next(kept, None)
    if one is None:
        return None
    call = one.call.removesuffix("()") + (f"({one.value})" if one.call.endswith("()") else "")
    place = one.stack.partition(" in ")[0]
    return (
        f"what came back from {shortened(printable(call), _CALL_MAX)} at {place}",
        f"guard: {{{one.source.value}: record}} in the job keeps it",
    )


def _inside(run: Run, view: EventView | None) -> list[Finding]:
    return run.trace.answers.get(view.index, []) if view is not None else []


def _before(run: Run, view: EventView | None) -> list[Finding]:
    """Return what the node of an event, or its main if it is of none, called before."""
    if view is None:
        return []
    node = node_of(view)
    files = _files_of(run, view)
    return [
        finding
        for index, found in run.trace.answers.items()
        for finding in found
        if (index < view.index and _is_of(run, finding, node, view))
        or _is_of_import(finding, files)
    ]


def _is_of(run: Run, finding: Finding, node: str, view: EventView) -> bool:
    if finding.node or node:
        return finding.node == node
    entity = run.trace.entities.get(finding.entity)
    return entity is not None and entity.kind is EntityKind.MAIN and entity.name == view.entity.name


def _is_of_import(finding: Finding, files: frozenset[str]) -> bool:
    """Whether a call was made while a module was imported, for no node in particular."""
    place, _, function = finding.stack.partition("\n")[0].partition(" in ")
    return not finding.node and function == "<module>" and place.rpartition(":")[0] in files


def _files_of(run: Run, view: EventView) -> frozenset[str]:
    """Return the files of the modules that a node or main uses, as places in code name them."""
    node = node_of(view)
    entities = run.trace.entities.values()
    if node:
        module = next((e.type for e in entities if e.name == node and e.type), "").partition(":")[0]
    else:
        mains = (e for e in entities if e.kind is EntityKind.MAIN and e.name == view.entity.name)
        file = next((e.source for e in mains), "").rpartition(":")[0]
        module = file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    names = [name.replace(".", "/") for name in used_by((run.trace, run.trace), module) if name]
    return frozenset(f"{name}{end}" for name in names for end in (".py", "/__init__.py"))


def _paired(a: list[Finding], b: list[Finding]) -> list[CallDifference]:
    """Pair the n-th findings of each call at each place; a file may lie in another folder.

    They come in the order in which they were made, in whichever run that was first.
    """
    places: dict[tuple[str, str], tuple[list[_Numbered], list[_Numbered]]] = {}
    for side, findings in enumerate((a, b)):
        for number, finding in enumerate(findings):
            place = (_FOLDER.sub(r"\1", finding.call), finding.stack)
            places.setdefault(place, ([], []))[side].append((finding.event, number, finding))
    calls = []
    for place, (of_a, of_b) in places.items():
        for x, y in zip_longest(of_a, of_b):
            made = min(one[:2] for one in (x, y) if one is not None)
            calls.append((made, place, _difference(x and x[2], y and y[2])))
    return [call for *_, call in sorted(calls, key=itemgetter(0, 1))]


def _difference(a: Finding | None, b: Finding | None) -> CallDifference:
    one = a or b
    assert one is not None
    return CallDifference(
        source=one.source.value,
        call=one.call,
        where=one.stack.partition("\n")[0],
        event_a=None if a is None else a.event,
        event_b=None if b is None else b.event,
        a=None if a is None else answer_text(a),
        b=None if b is None else answer_text(b),
    )
