"""The calls the guard found that can explain a divergence: in the event itself, or before it.

What a trace keeps of a call is text that the guard wrote (``os.environ['X']``, ``4 bytes, SHA-256
ab``). It is read here, once.
"""

from __future__ import annotations

import base64
import json
import os
import re
from itertools import zip_longest
from operator import attrgetter, itemgetter
from typing import Any

from rsltrace.diff.alignment.rows import ComparedTrace
from rsltrace.diff.causes.event_views import subject_of
from rsltrace.diff.causes.relevance import used_by
from rsltrace.diff.facts.causes import UnrecordedAnswer
from rsltrace.diff.facts.evidence import CallDifference, EventSummary
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.finding import Finding, GuardMode, NondeterminismSource
from rsltrace.trace.model.texts import contrasting_texts, printable, shortened

CALLS_MAX = 20
EARLIER_MAX = 3
_CALL_MAX = 60
_UNSEEN = ("C library: ", "SQLite: ", "open('/dev/urandom')", "open('/dev/random')")
"""What calls begin with whose answers no finding holds."""
_ENVIRONMENT, _THREAD = NondeterminismSource.ENVIRONMENT, NondeterminismSource.THREAD
_NEVER_KEPT = ("os.fork()", "os.forkpty()")
_ANSWERED = (NondeterminismSource.SOCKET, NondeterminismSource.PROCESS)
# Patterns, compiled at their first use: few traces have such calls.
_FOLDER = r"(['\"])/[^'\"]*/(?=[^'\"/]*\1)"
"""The folder of an absolute path between quotes."""

STARTED_BY = "subprocess.Popen("
_STARTED = "started"
_ANSWER_MAX = 60
_CHANGED = r"(\d+ bytes), changed \d+"
_VARIABLE = r"(?:os\.environ\[|getenv\()(['\"])(.+)\1[\])]"
_FILE = r"\w[\w.]*\((?:PosixPath\()?(['\"])(?:[^'\"]*/)?([^'\"/]+)\1"
_CONTENT = r"(\d+ bytes), (SHA-256 [0-9a-f]+)"

_Numbered = tuple[int, int, Finding]
"""A finding with its event, and its number among those of its run."""


def call_differences(
    run_a: ComparedTrace,
    run_b: ComparedTrace,
    a: EventSummary | None,
    b: EventSummary | None,
    node: str = "",
) -> tuple[CallDifference, ...]:
    """Return the calls made inside two events, those with different answers first.

    If all answers agree, the first calls before them in the same node, or when its modules were
    imported, that gave different ones come first: what was read earlier may show only now. So it is
    with the calls of an event that only one run has: they cannot be why it happened. ``node`` is
    another node that can be the cause.
    """
    inside = _paired(_inside(run_a, a), _inside(run_b, b))
    differing = [call for call in inside if call.differs]
    if differing and a is not None and b is not None:
        return (*differing, *(call for call in inside if not call.differs))[:CALLS_MAX]
    some = a or b
    is_somebodys = some is not None and (node or subject_of(some))
    # Where one run has no such event: up to there the two agree, indexes and all.
    sides = (_before(run_a, a or b, node), _before(run_b, b or a, node)) if is_somebodys else ()
    before = _paired(*sides) if sides else []
    earlier = [call for call in before if call.differs][:EARLIER_MAX]
    places = {call.where for call in earlier}
    programs = [c for c in before if c.call.startswith(STARTED_BY) and c.where in places]
    programs = [call for call in programs if call not in earlier][:EARLIER_MAX]
    return (*earlier, *programs, *inside)[:CALLS_MAX]


def unrecorded_answer(run: ComparedTrace, view: EventSummary) -> UnrecordedAnswer | None:
    """Return the last unrecorded answer of a socket or program, else of the C library, SQLite, a
    device or real time: in an event, else the last one before it in its node; None if there was
    none."""
    found = [f for f in (*_before(run, view), *_inside(run, view)) if f.mode is GuardMode.WARN]
    one = next((f for f in reversed(found) if f.source in _ANSWERED), None)
    if one is None:
        one = next((f for f in reversed(found) if _is_unseen(f)), None)
        source = _THREAD.value if one is not None and one.source is _THREAD else ""
        return UnrecordedAnswer(printable(one.call), one.place, source) if one else None
    call = one.call.removesuffix("()") + (f"({one.value})" if one.call.endswith("()") else "")
    source = "" if one.call in _NEVER_KEPT else one.source.value
    return UnrecordedAnswer(shortened(printable(call), _CALL_MAX), one.place, source)


def _is_unseen(finding: Finding) -> bool:
    return finding.source is _THREAD or finding.call.startswith(_UNSEEN)


def _inside(run: ComparedTrace, view: EventSummary | None) -> list[Finding]:
    return run.trace.answers.get(view.index, []) if view is not None else []


def _before(run: ComparedTrace, view: EventSummary | None, other: str = "") -> list[Finding]:
    """Return what a node called before an event: the event's own, or its main if it is of none, or
    another one."""
    if view is None:
        return []
    node = other or view.node
    files = _files_of(run, view, node)
    return [
        finding
        for index, found in run.trace.answers.items()
        for finding in found
        if (index < view.index and _is_of(run, finding, node, view))
        or _is_of_import(finding, files)
    ]


def _is_of(run: ComparedTrace, finding: Finding, node: str, view: EventSummary) -> bool:
    if node:
        return finding.node == node or (not finding.node and _has_made(run, finding, node))
    entity = run.trace.entities.get(finding.entity)
    return entity is not None and entity.kind is EntityKind.MAIN and entity.name == view.entity.name


def _has_made(run: ComparedTrace, finding: Finding, node: str) -> bool:
    """Whether a node was made in the event of a call: by the main that made both."""
    entities = run.trace.entities
    made = [
        entities.get(o.entity)
        for o in run.trace.outputs_of(finding.event)
        if o.kind is OutputKind.ENTITY
    ]
    return any(e is not None and e.kind is EntityKind.NODE and e.name == node for e in made)


def _is_of_import(finding: Finding, files: frozenset[str]) -> bool:
    """Whether a call was made while a module was imported, for no node in particular."""
    place, _, function = finding.stack.partition("\n")[0].partition(" in ")
    return not finding.node and function == "<module>" and place.rpartition(":")[0] in files


def _files_of(run: ComparedTrace, view: EventSummary, node: str) -> frozenset[str]:
    """Return the files of the modules that a node or main uses, as places in code name them."""
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
    """Pair the n-th findings of each call at each place, then those in the same functions: an edit
    moves lines. A file may lie in another folder.

    They come in the order in which they were made, in whichever run that was first.
    """
    calls = []
    rest = [[(one.event, number, one) for number, one in enumerate(found)] for found in (a, b)]
    for place_of in (attrgetter("stack"), _functions):
        places: dict[tuple[str, str], tuple[list[_Numbered], list[_Numbered]]] = {}
        for side, found in enumerate(rest):
            for one in found:
                place = (re.sub(_FOLDER, r"\1", one[2].call), place_of(one[2]))
                places.setdefault(place, ([], []))[side].append(one)
        pairs = [(at, *pair) for at, sides in places.items() for pair in zip_longest(*sides)]
        rest = [[x for _, x, y in pairs if x and not y], [y for _, x, y in pairs if y and not x]]
        for place, x, y in pairs:
            if (x and y) or place_of is _functions:
                made = min(one[:2] for one in (x, y) if one is not None)
                calls.append((made, place, _difference(x and x[2], y and y[2])))
    return [call for *_, call in sorted(calls, key=itemgetter(0, 1))]


def _functions(finding: Finding) -> str:
    return "\n".join(line.partition(" in ")[2] for line in finding.stack.splitlines())


def _difference(a: Finding | None, b: Finding | None) -> CallDifference:
    one = a or b
    assert one is not None
    return call_difference(
        one.source.value,
        one.call,
        one.stack.partition("\n")[0],
        (None if a is None else a.event, None if b is None else b.event),
        (None if a is None else answer_text(a), None if b is None else answer_text(b)),
    )


def call_difference(
    source: str,
    call: str,
    where: str,
    events: tuple[int | None, int | None],
    answers: tuple[str | None, str | None],
) -> CallDifference:
    """Return a call of both runs, or of one, with what distinguishes its answers."""
    a, b = answers
    touched = [re.fullmatch(_CHANGED, value or "") for value in answers]
    return CallDifference(
        source,
        call,
        where,
        *events,
        a,
        b,
        subject=subject_of_call(source, call),
        short=("", "") if a is None or b is None else _short(source, a, b),
        only_touched=bool(touched[0] and touched[1] and touched[0][1] == touched[1][1]),
    )


def subject_of_call(source: str, call: str) -> str:
    """Return what a call asks for: ``MOTOR_SEED``, ``gains.yaml``; else the call."""
    found = None
    if source == NondeterminismSource.ENVIRONMENT.value:
        found = re.match(_VARIABLE, call)
    elif source in (NondeterminismSource.FILE.value, NondeterminismSource.DIRECTORY.value):
        found = re.match(_FILE, call)
    return found[2] if found else call


def _short(source: str, a: str, b: str) -> tuple[str, str]:
    contents = re.fullmatch(_CONTENT, a), re.fullmatch(_CONTENT, b)
    if contents[0] and contents[1] and contents[0][1] == contents[1][1]:
        a, b = contents[0][2], contents[1][2]
    sizes = re.fullmatch(_CHANGED, a), re.fullmatch(_CHANGED, b)
    if sizes[0] and sizes[1] and sizes[0][1] != sizes[1][1]:
        a, b = sizes[0][1], sizes[1][1]
    if source == NondeterminismSource.ENVIRONMENT.value:
        a, b = unquoted(a), unquoted(b)
    return contrasting_texts(a, b, _ANSWER_MAX)


def unquoted(text: str, quote: str = "'") -> str:
    """Return a plain word without its quotes."""
    inner = text[1:-1]
    quoted = len(text) > 2 and text[0] == text[-1] == quote
    return inner if quoted and re.fullmatch(r"[\w./:+-]+", inner) else text


def answer_text(finding: Finding) -> str:
    """Return ``b'1.5\\n'`` of an answer that is kept as JSON, ``exit status 4`` of how a program
    ended; of a program that was started no more than that, as its number is another one each
    time. Other answers are returned as they are."""
    if finding.mode is not GuardMode.RECORD:
        return finding.value
    if finding.call.startswith(STARTED_BY) and finding.value.isdecimal():
        return _STARTED
    try:
        value = json.loads(finding.value)
        value = value["then"] if isinstance(value, dict) and "of" in value else value
        text = _exit_text(value) if finding.call == "os.waitpid()" else _text(value)
        return text.removeprefix("b") if finding.source is _ENVIRONMENT else text
    except (ValueError, TypeError, KeyError, IndexError, RecursionError):
        return finding.value


def _exit_text(value: Any) -> str:
    status = os.waitstatus_to_exitcode(int(value["tuple"][1]))
    return f"exit status {status}" if status >= 0 else f"ended by signal {-status}"


def _text(value: Any) -> str:
    return str(_AnswerText(value)) if isinstance(value, (dict, list)) else repr(value)


class _AnswerText:
    """A decoded value whose ``repr`` is that of the answer itself."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def __repr__(self) -> str:
        value = self._value
        if isinstance(value, list):
            return repr([_AnswerText(item) for item in value])
        if isinstance(value, dict) and "bytes" in value:
            return repr(base64.b64decode(value["bytes"], validate=True))
        if isinstance(value, dict) and "tuple" in value:
            return repr(tuple(_AnswerText(item) for item in value["tuple"]))
        if isinstance(value, dict) and "error" in value:
            kind, _, text, *_ = value["error"]
            return f"{kind}: {text}"
        return repr(value)
