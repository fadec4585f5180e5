"""Finds the callback that is meant, or why there is none."""

from __future__ import annotations

from typing import NoReturn

from rsltrace.conditions.names import nodes_called
from rsltrace.errors import TraceError, near_or_all, nearest
from rsltrace.trace.model.entity import Entity, EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.operation import is_built_in
from rsltrace.trace.model.texts import printable
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.events import EventWords
from rsltrace.why.graph import NotConstructed, NotReceived
from rsltrace.why.history import RunHistory
from rsltrace.why.question import SENDERS, WITH_CALLBACK, Question, filter_of
from rsltrace.why.reason import Reason

_NAMED = (EntityKind.PUBLISHER, *SENDERS)


def find_target(history: RunHistory, node: str, asked: str, at_ns: int | None) -> Question | Reason:
    """Return the question; or a reason, if there is no such callback but should be.

    :raises TraceError: no node, topic or callback has that name, or several have.
    """
    trace = history.trace
    nodes = [one for one in trace.entities.values() if one.kind is EntityKind.NODE]
    called = nodes_called(node, [one.name for one in nodes])
    if not called:
        known = [one.name for one in nodes]
        reason = None if nearest(node, known) else _not_begun(history, node)
        return reason or _fail(trace, "node", node, known)
    own = [one for one in nodes if one.name == called[0]]
    ids = {one.id for one in own}
    there = [e for e in trace.entities.values() if e.node in ids and e.kind in WITH_CALLBACK]
    found = [one for one in there if _is_meant(one, asked)]
    if len({filter_of(e) or (e.kind, e.name, e.detail.get("callback")) for e in found}) > 1:
        listed = ", ".join(f"{e.id} ({e.kind.label} {e.name}: {_callbacks(e)[-1]})" for e in found)
        text = f"{called[0]} has several {asked}; give a number: {listed}"
        raise TraceError(printable(text))
    if found:
        made = [e for e in found if at_ns is None or e.created_ns <= at_ns]
        return Question(history, (made or found)[-1], at_ns)
    question = Question(history, own[-1], at_ns)
    event = history.made_by(own[-1].id)
    if (raised := question.raised(event)) is not None:
        what = (printable(called[0]), raised[0])
        return NotConstructed(*what, question=question, place=raised[1], event=event)
    there = [one for one in there if not is_built_in(one)]
    received = [one for one in there if one.kind in SENDERS]
    topic = f"/{asked.lstrip('/')}"
    if any(one.name == topic and one.kind in _NAMED for one in trace.entities.values()):
        last = topic.rpartition("/")[2]
        near = [one for one in received if one.name.rpartition("/")[2] == last] or received
        names = tuple(printable(one.name) for one in near)
        place = next((one.source for one in near if one.source), own[-1].source)
        return NotReceived(printable(topic), names, question=question, place=place)
    callbacks = [str(one.detail.get("callback") or one.name) for one in there]
    names_there = [*(one.name for one in received), *callbacks]
    return _fail(trace, f"callback of {called[0]}", asked, names_there)


def _callbacks(entity: Entity) -> list[str]:
    of = filter_of(entity)
    return [str(entity.detail.get("callback") or entity.name), *([of[0]] if of else [])]


def _is_meant(entity: Entity, asked: str) -> bool:
    callbacks = _callbacks(entity)
    names = {entity.name, str(entity.id), *callbacks, *(c.rpartition(".")[2] for c in callbacks)}
    return asked in names or f"/{asked}" == entity.name


def _not_begun(history: RunHistory, node: str) -> Reason | None:
    """Return why a node of the job was never constructed, None if all were."""
    trace, question = history.trace, Question(history, history.trace.entity(0))
    kinds = history.events["kind"][: history.ended].tolist()
    constructs = [event for event, kind in enumerate(kinds) if kind == EventKind.CONSTRUCT]
    if len(question.rules("nodes")) <= len(constructs):
        return None
    for event in constructs:
        if (raised := question.raised(event)) is not None:
            other = EventWords(trace).node(trace.event(event), trace.outputs_of(event))
            what = (printable(f"/{node.lstrip('/')}"), raised[0], other or "another node")
            return NotConstructed(*what, question=question, place=raised[1], event=event)
    return None


def _fail(trace: Trace, what: str, word: str, names: list[str]) -> NoReturn:
    text = f"has no {what} that is called {word!r}{near_or_all(word, names)}"
    raise TraceError(f"{trace.name} {printable(text)}")
