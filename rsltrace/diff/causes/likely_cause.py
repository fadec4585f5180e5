"""What came from outside and is likely behind a divergence: who read what, and what it was."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from rsltrace.diff.alignment.rows import Run
from rsltrace.diff.causes.answers import STARTED_BY, answers_apart
from rsltrace.diff.causes.call_differences import unrecorded_call
from rsltrace.diff.causes.classify import Judgement
from rsltrace.diff.causes.event_views import subject_of
from rsltrace.diff.causes.relevance import Relevance
from rsltrace.diff.causes.set_order import set_behind
from rsltrace.diff.causes.wording import MADE_DIFFERENTLY, NAMED_MAX
from rsltrace.diff.result.divergence import CallDifference, MessageDifference
from rsltrace.diff.result.events import EventView
from rsltrace.diff.result.verdicts import Root
from rsltrace.model.finding import Source
from rsltrace.model.printable import printable

NOT_DETERMINISTIC = "not deterministic"
_ANSWER_MAX = 60
_OF_PROGRAMS = ("os.read()", "os.waitpid()")
"""What ``subprocess`` asks of the system about the program that it has started."""

_CHANGED = re.compile(r"(\d+ bytes), changed \d+")
_VARIABLE = re.compile(r"os\.environ\[(['\"])(.+)\1\]")
_FILE = re.compile(r"\w[\w.]*\((?:PosixPath\()?(['\"])(?:[^'\"]*/)?([^'\"/]+)\1")
_CONTENT = re.compile(r"(\d+ bytes), (SHA-256 [0-9a-f]+)")
_VERBS = {
    Source.ENVIRONMENT: "read",
    Source.PID: "read",
    Source.FILE: "read",
    Source.DIRECTORY: "listed",
    Source.CLOCK: "read",
    Source.RANDOM: "drew",
    Source.SOCKET: "called",
}


_OPEN_TO_IT = frozenset(
    (Root.CALLBACK, Root.TIMING, Root.MISSING, Root.EXTRA, Root.EXCEPTION, Root.SCHEDULE, Root.JOB)
)
"""Roots that what a node read from outside can be behind."""


def with_likely_cause(
    judgement: Judgement,
    run: Run,
    messages: Sequence[MessageDifference],
    calls: Sequence[CallDifference],
    relevance: Relevance,
) -> Judgement:
    """Return a verdict on a root that names what explains it: the first of ``calls`` if its answers
    differ, or a set whose order shows. ``run`` is one that has the event."""
    view = judgement.a or judgement.b
    if judgement.root not in _OPEN_TO_IT or not judgement.root_sentence or view is None:
        return judgement
    if calls and calls[0].a != calls[0].b:
        text = calls_sentence(calls, subject_of(view), messages)
    else:
        text = set_behind(run, view, messages, calls, relevance)
    if not text:
        return _with_unrecorded(judgement, run, view)
    _, made_differently, others = judgement.root_sentence.partition(MADE_DIFFERENTLY)
    why = f"{text}; and {made_differently}{others}" if made_differently else text
    sentence = f"{judgement.sentence}; likely cause: {text}"
    return replace(judgement, sentence=sentence, root_sentence=why, likely_cause=text)


def _with_unrecorded(judgement: Judgement, run: Run, view: EventView) -> Judgement:
    """Name the answer that nobody kept, where nothing that is known explains a divergence."""
    if NOT_DETERMINISTIC not in judgement.root_sentence:
        return judgement
    found = unrecorded_call(run, view)
    if found is None:
        return judgement
    call, advice = found
    return replace(
        judgement,
        sentence=f"{judgement.sentence}; possible cause: {call}, which is not recorded",
        root_sentence=f"{judgement.root_sentence}; {call} is not recorded ({advice})",
    )


def calls_sentence(
    calls: Sequence[CallDifference], node: str, messages: Sequence[MessageDifference]
) -> str:
    """Return the calls with different answers as a sentence. Of several those whose answers show in
    what differs, if there are such; else all may be the cause."""
    differing = list({(c.call, c.where): c for c in reversed(calls) if c.a != c.b}.values())[::-1]
    differing = [c for c in differing if not _is_touched(c)] or differing
    if len(differing) > 1:
        shown = _shown(messages)
        telling = [c for c in differing if {_unquoted(v) for v in (c.a, c.b) if v} & shown]
        differing = telling or differing
    programs = {c.where: c.call for c in calls if c.call.startswith(STARTED_BY)}
    of_programs = [
        replace(c, call=programs[c.where]) if c.call in _OF_PROGRAMS and c.where in programs else c
        for c in differing
    ]
    told = list(dict.fromkeys(call_sentence(call, node) for call in of_programs))
    first, *others = told[:NAMED_MAX]
    more = len(told) - NAMED_MAX
    text = "; ".join([first, *(other.removeprefix(f"{node} ") for other in others)])
    return f"{text}; and {more} more" if more > 0 else text


def _is_touched(call: CallDifference) -> bool:
    """Whether nothing of a file differs but when it was written."""
    files = [_CHANGED.fullmatch(value or "") for value in (call.a, call.b)]
    return bool(files[0] and files[1] and files[0][1] == files[1][1])


def _shown(messages: Sequence[MessageDifference]) -> set[str]:
    texts = {word for message in messages for word in message.topic.split()}
    return texts | {
        _unquoted(value, '"')
        for m in messages
        for field in m.fields
        for value in (field.a, field.b)
    }


def call_sentence(call: CallDifference, node: str) -> str:
    """Return ``/picker read MOTOR_SEED, 6 in a and 4 in b, at picker.py:24``."""
    source = Source(call.source)
    place = call.where.partition(" in ")[0]
    done = (
        f"{node or 'the run'} {_VERBS.get(source, 'called')} {printable(_what(source, call.call))}"
    )
    if call.a is None or call.b is None:
        return f"{done} only in {'b' if call.a is None else 'a'}, at {place}"
    a, b = _answers(source, call.a, call.b)
    return f"{done}, {a} in a and {b} in b, at {place}"


def _what(source: Source, call: str) -> str:
    if source is Source.ENVIRONMENT and (found := _VARIABLE.match(call)):
        return found[2]
    if source in (Source.FILE, Source.DIRECTORY) and (found := _FILE.match(call)):
        return found[2]
    return call


def _answers(source: Source, a: str, b: str) -> tuple[str, str]:
    contents = _CONTENT.fullmatch(a), _CONTENT.fullmatch(b)
    if contents[0] and contents[1] and contents[0][1] == contents[1][1]:
        a, b = contents[0][2], contents[1][2]
    sizes = _CHANGED.fullmatch(a), _CHANGED.fullmatch(b)
    if sizes[0] and sizes[1] and sizes[0][1] != sizes[1][1]:
        a, b = sizes[0][1], sizes[1][1]
    if source is Source.ENVIRONMENT:
        a, b = _unquoted(a), _unquoted(b)
    return answers_apart(a, b, _ANSWER_MAX)


def _unquoted(text: str, quote: str = "'") -> str:
    inner = text[1:-1]
    quoted = len(text) > 2 and text[0] == text[-1] == quote
    return inner if quoted and re.fullmatch(r"[\w./:+-]+", inner) else text
