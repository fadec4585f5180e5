"""What a person wants to know of two runs that diverge, in one sentence.

Parameter speed 1.2 → 1.25 (job.yaml:14); first effect: /follower published another linear.x on
/cmd_vel at 0.1 s (linear.x 0.6 → 0.625).
"""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.causes.effects import PARAMETER_EVENTS
from rsltrace.diff.causes.event_views import node_of, phrase
from rsltrace.diff.causes.wording import field_text, listed
from rsltrace.diff.result.divergence import Divergence, MessageDifference
from rsltrace.diff.result.settings import Setting
from rsltrace.diff.result.verdicts import Verdict
from rsltrace.model.event import EventKind, OutputKind
from rsltrace.model.printable import printable
from rsltrace.words.phrases import at_time

_VALUE_MAX = 40
_CODE = "code of module "
_PARAMETERS = ".parameters."
_VERBS = {
    OutputKind.MESSAGE: ("published", "on "),
    OutputKind.REQUEST: ("called", ""),
    OutputKind.RESPONSE: ("answered", ""),
}
_OTHER_OUTPUT = (Verdict.SAME_INPUT_DIFFERENT_OUTPUT, Verdict.ENVIRONMENT)


def headline(first: Divergence, effect: Divergence | None, *, in_vain: str | None = None) -> str:
    """Return the settings that are to blame for a divergence, and the first effect they had.

    ``in_vain`` says up to where no effect was found (empty: to the end), if one was looked for.
    """
    settings = (*(effect.settings if effect is not None else ()), *first.settings)
    setup = effect is not None or in_vain is not None
    lead = _lead(tuple(dict.fromkeys(settings)), setup=setup)
    if effect is not None:
        lead = lead or first.likely_cause or first.sentence
        return f"{lead}; first effect: {effect_text(effect)}"
    if not lead:
        return first.sentence
    one = first.a or first.b
    if in_vain is not None and one is not None:
        topics = listed([message.topic for message in first.messages if message.position >= 0])
        where = f"on {topics}" if topics else f"on the state of {node_of(one)}"
        return f"{lead}; no effect{in_vain} but {where}, by {phrase(one)}"
    return f"{lead}; first effect: {effect_text(first)}"


def effect_text(found: Divergence) -> str:
    """Return ``/follower published another linear.x on /cmd_vel at 0.1 s (linear.x 1 → 2)``, or
    the sentence of a divergence that is no other output."""
    one = found.a or found.b
    sent = [m for m in found.messages if m.kind in _VERBS and m.topic != PARAMETER_EVENTS]
    told = found.verdict in _OTHER_OUTPUT and one is not None and not _has_input(found)
    if not told or not sent or found.messages[0].kind not in (*_VERBS, OutputKind.LOG):
        return found.sentence
    assert one is not None
    message = sent[0]
    values = field_text(message.fields, message.more_fields)
    who = node_of(one) or (f"{one.entity.kind} {one.entity.name}" if one.entity.name else "the run")
    text = f"{who} {_done(message)} {_when(one.kind, one.stamp_ns)}"
    more = f" and {len(sent) - 1} more" if len(sent) > 1 else ""
    return f"{text}{f' ({values})' if values else ''}{more}"


def _has_input(found: Divergence) -> bool:
    return any(message.position < 0 for message in found.messages)


def _when(kind: EventKind, stamp_ns: int) -> str:
    return "in its constructor" if kind is EventKind.CONSTRUCT else at_time(stamp_ns)


def _done(message: MessageDifference) -> str:
    verb, on = _VERBS[message.kind or OutputKind.MESSAGE]
    if message.presence != "both":
        what = f"{message.note}" if message.note else message.presence.replace("only", "only in")
        return f"{verb} {on}{message.topic} {what}"
    if message.note:
        return f"{verb} {on}{message.topic} {message.note}"
    fields = message.fields
    other = "message" if message.kind is OutputKind.MESSAGE else "content"
    if fields:
        more = len(fields) - 1 + message.more_fields
        other = fields[0].path
        other += f" and {more} more field{'s' if more > 1 else ''}" if more else ""
    if message.kind is OutputKind.MESSAGE:
        return f"published another {other} on {message.topic}"
    return f"{verb} {message.topic} with another {other}"


def _lead(settings: Sequence[Setting], *, setup: bool) -> str:
    """Return the keys of the job that are to blame, with their lines; of what a constructor did,
    the code, too."""
    of_job = [_setting(setting) for setting in settings if setting.key]
    if not of_job and setup:
        of_job = [
            f"the {setting.place} is another one"
            for setting in settings
            if setting.place.startswith(_CODE)
        ]
    return listed(of_job)


def _setting(setting: Setting) -> str:
    parameter = setting.key.partition(_PARAMETERS)[2]
    name = printable(f"parameter {parameter}" if parameter else f"setting {setting.key}")
    place = f" ({printable(setting.place)})" if setting.place != "job" else ""
    values = [value for value in (setting.a, setting.b) if value is not None]
    if any(len(value) > _VALUE_MAX or "\n" in value for value in values):
        which = "differs" if len(values) == 2 else f"only in {'b' if setting.a is None else 'a'}"
        return f"{name} {which}{place}"
    shown = [printable(value) for value in values]
    if len(shown) == 2:
        return f"{name} {' → '.join(shown)}{place}"
    return f"{name} {''.join(shown)} only in {'b' if setting.a is None else 'a'}{place}"
