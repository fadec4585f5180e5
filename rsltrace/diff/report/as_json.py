"""A diff as JSON, for programs. ``docs/reference/diff-json.md`` describes it; keys are only added.

Facts are objects with their class as ``fact``, or a word where there is nothing more to say; beside
them stand the sentences for people. Times are integers of nanoseconds; hashes are 16 hex digits,
since JSON readers lose digits of 64-bit numbers; what is not there is null.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

from rsltrace.diff.facts.bags import MessageDivergence
from rsltrace.diff.facts.causes import Judgement, SameCause
from rsltrace.diff.facts.evidence import (
    CauseStep,
    EventSummary,
    Fact,
    FieldDifference,
    MessageDifference,
    Setting,
)
from rsltrace.diff.options import exit_code_of_several
from rsltrace.diff.result import BagDiff, Diff, Divergence
from rsltrace.diff.sentences import sentence
from rsltrace.diff.sentences.runs import order_text
from rsltrace.diff.sentences.values import link_text, no_fields_text, notes_text, output_change_text
from rsltrace.trace.model.event import NO_EVENT, EventFlag, EventKind, OutputKind
from rsltrace.trace.model.texts import format_seconds
from rsltrace.trace.words.entities import EntityKey, flag_names

FORMAT = "rsltrace-diff"
VERSION = 1
_HASHES = frozenset(("input_hash", "output_hash", "state_hash", "hash_a", "hash_b"))


def as_json(diff: Diff | BagDiff) -> dict[str, Any]:
    """Return one diff as what ``json`` writes (without NaN: those are texts)."""
    kind = "traces" if isinstance(diff, Diff) else "bags"
    result = {"format": FORMAT, "version": VERSION, "kind": kind, **_fields(diff)}
    result["sentence"], result["notes"] = diff.sentence, list(diff.notes)
    result["identical"] = diff.identical
    result["exit_code"] = diff.exit_code
    result["failed"] = diff.failed
    result["within_tolerance"] = diff.within_tolerance
    if isinstance(diff, Diff):
        if diff.native is None:
            del result["native"]
        result["tolerance"] = None if diff.tolerance is None else as_json(diff.tolerance)
        result["resync_index"] = _sides(diff.resync_index)
        result["aligned_to"] = _sides(diff.aligned_to)
    return result


def several_as_json(diffs: Sequence[Diff | BagDiff]) -> dict[str, Any]:
    """Return the diffs of several runs against one."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "kind": "several",
        "golden": diffs[0].a.path,
        "exit_code": exit_code_of_several(diff.exit_code for diff in diffs),
        "runs": [as_json(diff) for diff in diffs],
    }


def _fields(value: Any) -> dict[str, Any]:
    return {
        field.name: _plain(field.name, getattr(value, field.name))
        for field in dataclasses.fields(value)
    }


def _plain(name: str, value: Any) -> Any:
    for kind, form in _FORMS.items():
        if type(value) is kind:
            return form(value)
    if isinstance(value, (EventKind, OutputKind)):
        return value.label
    if isinstance(value, EventFlag):
        return flag_names(value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Fact):
        return {"fact": _snake(type(value).__name__), **_fields(value)}
    if dataclasses.is_dataclass(value):
        return _fields(value)
    if isinstance(value, tuple):
        return [_plain(name, item) for item in value]
    if name in _HASHES and isinstance(value, int):
        return f"{value:016x}"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def _snake(name: str) -> str:
    return re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower()


def _divergence(found: Divergence) -> dict[str, Any]:
    sentences = {"sentence": found.sentence, "root_sentence": found.root_sentence}
    sentences["absence_sentence"] = "" if found.absence is None else sentence(found.absence)
    return {**_fields(found), **sentences, "likely_cause": found.likely_cause}


def _judgement(found: Judgement) -> dict[str, Any]:
    """Return a divergence that another one refers to: what and why, without the evidence."""
    kept = ("verdict", "root", "what", "why", "a", "b", "settings", "likely")
    return {name: _plain(name, getattr(found, name)) for name in kept}


def _message(message: MessageDifference) -> dict[str, Any]:
    return {
        **_fields(message),
        "note": output_change_text(message),
        "reason": no_fields_text(message),
    }


def _bag_message(found: MessageDivergence) -> dict[str, Any]:
    return {**_fields(found), "note": order_text(found), "reason": no_fields_text(found)}


def _setting(setting: Setting) -> dict[str, Any]:
    return {"place": setting.place, **_fields(setting)}


def _field(found: FieldDifference) -> dict[str, Any]:
    return {**_fields(found), "note": notes_text(found)}


def _step(step: CauseStep) -> dict[str, Any]:
    return {**_fields(step), "relation": link_text(step.link)}


def _event(event: EventSummary) -> dict[str, Any]:
    result = _fields(event)
    result["entity"] = _entity(event.entity)
    result["time"] = format_seconds(int(event.stamp_ns))
    if event.cause_event == NO_EVENT:
        result["cause_event"] = result["cause_output"] = None
    return result


def _entity(key: EntityKey) -> dict[str, Any]:
    return _fields(key)


def _sides(pair: tuple[int, int] | None) -> dict[str, int] | None:
    return None if pair is None else {"a": pair[0], "b": pair[1]}


_FORMS: dict[type, Callable[[Any], Any]] = {
    EventSummary: _event,
    Divergence: _divergence,
    Judgement: _judgement,
    SameCause: lambda why: {"fact": "same_cause", "first": _judgement(why.first)},
    MessageDifference: _message,
    MessageDivergence: _bag_message,
    Setting: _setting,
    FieldDifference: _field,
    CauseStep: _step,
}
