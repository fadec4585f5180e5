"""The first line of a report on two runs that diverge: the settings that can be the cause, and
the first effect they had."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.facts.causes import (
    DivergenceKind,
    ErrorInTransition,
    Judgement,
    PossibleCause,
    Verdict,
)
from rsltrace.diff.facts.evidence import (
    MessageDifference,
    ParameterChanges,
    ParameterValues,
    Presence,
    Setting,
    SettingKind,
)
from rsltrace.diff.sentences import sentence
from rsltrace.diff.sentences.divergence import phrase, sentence_of
from rsltrace.diff.sentences.values import IN_ONE, field_text, listed, output_change_text, pair_text
from rsltrace.trace.model.event import EventKind, OutputKind
from rsltrace.trace.model.operation import PARAMETER_EVENTS
from rsltrace.trace.model.texts import counted, printable, shortened
from rsltrace.trace.words.phrases import at_time

_VALUE_MAX = 40
_PARAMETERS = ".parameters."
_OTHER_OUTPUT = (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Verdict.ENVIRONMENT)
_SENT = {
    OutputKind.MESSAGE: ("published", "on "),
    OutputKind.REQUEST: ("called", ""),
    OutputKind.RESPONSE: ("answered", ""),
}


def headline(first: Judgement, effect: Judgement | None, searched_to: int | None) -> str:
    """Return the headline of two runs that diverge: the settings that can be the cause,
    and the first effect they had.

    ``searched_to`` is up to which event no effect was found (-1: to the end), None if it was not
    looked for.
    """
    settings = (*(effect.settings if effect is not None else ()), *first.settings)
    set_up = effect is not None or searched_to is not None
    lead = _lead(tuple(dict.fromkeys(settings)), first if set_up else None)
    if effect is not None:
        known = first.likely is not None and not isinstance(first.likely, PossibleCause)
        lead = lead or (sentence(first.likely) if known else sentence_of(first))
        return f"{lead}; first effect: {effect_text(effect)}"
    if not lead:
        return sentence_of(first)
    one = first.one
    up_to = "" if searched_to is None or searched_to < 0 else f" up to event {searched_to}"
    if first.what is DivergenceKind.ONLY_ZERO_DELAYS:
        return f"{lead}; no effect{up_to}: {sentence_of(first)}"
    if searched_to is not None and one is not None:
        topics = listed([message.topic for message in first.messages if not message.is_input])
        where = f"on {topics}" if topics else f"on the state of {one.node}"
        return f"{lead}; no effect{up_to} except {where}, by {phrase(one)}"
    return f"{lead}; first effect: {effect_text(first)}"


def effect_text(found: Judgement) -> str:
    """Return ``/follower published another linear.x on /cmd_vel at 0.1 s (linear.x 1 → 2)``, or
    the sentence of a divergence that is no other output."""
    one = found.one
    sent = [m for m in found.messages if m.kind in _SENT and m.topic != PARAMETER_EVENTS]
    if isinstance(found.likely, ErrorInTransition):
        return sentence(found.likely)
    is_output = found.verdict in _OTHER_OUTPUT and not any(m.is_input for m in found.messages)
    if one is None or not is_output or not sent:
        return sentence_of(found)
    if found.messages[0].kind not in (*_SENT, OutputKind.LOG):
        return sentence_of(found)
    message = sent[0]
    values = field_text(message.fields, message.more_fields)
    who = one.node or (f"{one.entity.kind} {one.entity.name}" if one.entity.name else "the run")
    is_made = one.kind is EventKind.CONSTRUCT
    when = "in its constructor" if is_made else at_time(one.stamp_ns)
    more = f" and {counted(len(sent) - 1, 'more output')}" if len(sent) > 1 else ""
    return f"{who} {_done(message)} {when}{f' ({values})' if values else ''}{more}"


def _done(message: MessageDifference) -> str:
    verb, on = _SENT[message.kind or OutputKind.MESSAGE]
    if message.fate is not None or message.presence is not Presence.BOTH:
        what = output_change_text(message) or IN_ONE[message.presence]
        return f"{verb} {on}{message.topic} {what}"
    other = "message" if message.kind is OutputKind.MESSAGE else "content"
    if message.fields:
        other = message.fields[0].path
    if message.kind is OutputKind.MESSAGE:
        return f"published a different {other} on {message.topic}"
    return f"{verb} {message.topic} with a different {other}"


def _lead(settings: Sequence[Setting], constructor: Judgement | None) -> str:
    """Return the keys of the job that can be the cause, with their lines; for a constructor,
    the code, too, with the parameters that differ."""
    of_job = [_setting(setting) for setting in settings if setting.key]
    if of_job or constructor is None:
        return listed(of_job)
    code = [s.place for s in settings if s.kind in (SettingKind.CODE, SettingKind.FILE)]
    parameters = _parameters(constructor)
    if code and parameters:
        return f"{listed(parameters)} ({listed(code)})"
    return listed([f"the {place} differs" for place in code])


def _parameters(constructor: Judgement) -> list[str]:
    """Return the parameters that a constructor set to another value, with the values."""
    found = []
    for message in constructor.messages:
        node = message.entity.node  # a main may construct several
        if isinstance(message.fate, ParameterChanges):
            changed = message.fate.values
            found += [f"parameter {name} of {node} {pair_text(a, b)}" for name, a, b in changed]
        elif isinstance(message.fate, ParameterValues) and message.presence in IN_ONE:
            where = IN_ONE[message.presence]
            found += [
                f"parameter {name} of {node} {shortened(value, _VALUE_MAX)} {where}"
                for name, value in message.fate.values
            ]
    return found


def _setting(setting: Setting) -> str:
    parameter = setting.key.partition(_PARAMETERS)[2]
    name = printable(f"parameter {parameter}" if parameter else f"setting {setting.key}")
    place = f" ({printable(setting.place)})" if setting.line else ""
    values = [value for value in (setting.a, setting.b) if value is not None]
    only = f"only in {'b' if setting.a is None else 'a'}"
    if any(len(value) > _VALUE_MAX or "\n" in value for value in values):
        return f"{name} {'differs' if len(values) == 2 else only}{place}"
    if len(values) == 2:
        return f"{name} {pair_text(setting.a, setting.b)}{place}"
    return f"{name} {printable(''.join(values))} {only}{place}"
