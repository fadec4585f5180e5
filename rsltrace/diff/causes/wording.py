"""What two events did otherwise, in the words of one sentence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rsltrace.diff.causes.output_notes import IN_ANOTHER_ORDER
from rsltrace.diff.result.divergence import MessageDifference, StateDifference
from rsltrace.diff.result.fields import SAME_ELEMENTS, SAME_WORDS, FieldDifference
from rsltrace.diff.result.settings import Setting
from rsltrace.diff.values.constants import NAMED
from rsltrace.model.event import OutputKind
from rsltrace.model.printable import shortened

MADE_DIFFERENTLY = "the runs were made differently"
"""How settings that can be the cause are introduced."""

NAMED_MAX = 3
_VALUE_MAX = 40
_SETTING_MAX = 60

_IN_ONE = {"only a": " only in a", "only b": " only in b"}
_LABELS = {OutputKind.REQUEST: "call ", OutputKind.RESPONSE: "reply "}


def a_first(messages: Sequence[MessageDifference]) -> list[MessageDifference]:
    """Return messages with what is only in a in front, among as many as a sentence names."""
    named = sorted(messages[:NAMED_MAX], key=lambda message: message.presence == "only b")
    return [*named, *messages[NAMED_MAX:]]


def what_differs(messages: Sequence[MessageDifference]) -> str:
    """Return `` (/odom: pose.x 1.0 → 1.5, call /plan only in b)``, "" if no output differs."""
    outputs = [m for m in messages if m.position >= 0]
    moved = [_label(m) for m in outputs if m.note == IN_ANOTHER_ORDER]
    things = [_thing(m) for m in a_first([m for m in outputs if m.note != IN_ANOTHER_ORDER])]
    times = Counter(things)
    things = [f"{thing}, {n} times" if n > 1 else thing for thing, n in times.items()]
    if moved:
        things.insert(0, f"{_and(moved)} {IN_ANOTHER_ORDER}")
    return f" ({listed(things)})" if things else ""


def state_text(state: Sequence[StateDifference]) -> str:
    """Return `` (count 3 → 4)``, "" if nothing is known of it."""
    if not state:
        return ""
    first = state[0]
    a, b = ("nothing" if v is None else shortened(v, _VALUE_MAX) for v in (first.a, first.b))
    more = f" and {len(state) - 1} more" if len(state) > 1 else ""
    return f" ({first.path} {a} → {b}{more})"


def field_text(fields: Sequence[FieldDifference], more_fields: int) -> str:
    """Return what differs in a message: ``data 0.28026 → 0.28027``, and how many more fields."""
    if not fields:
        return ""
    first = fields[0]
    if SAME_ELEMENTS in first.note:
        text = f"{first.path} has {SAME_ELEMENTS}"
    elif first.elements is not None and first.elements[0] > 1:
        text = f"{first.elements[0]} of {first.elements[1]} elements of {first.path}"
    else:
        a, b = (shortened(value, _VALUE_MAX) for value in (first.a, first.b))
        text = f"{first.path} {a} → {b}"
        text += f" ({first.note})" if NAMED in first.note or first.note == SAME_WORDS else ""
    more = len(fields) - 1 + more_fields
    return f"{text} and {more} more field{'s' if more > 1 else ''}" if more else text


def because_of(settings: Sequence[Setting]) -> str:
    """Say that the runs were made differently, and how; "" if they were not."""
    if not settings:
        return ""
    return f"{MADE_DIFFERENTLY}: {listed([_setting_text(one) for one in settings])}"


def _setting_text(setting: Setting) -> str:
    if not setting.key:
        return str(setting)
    values = [value for value in (setting.a, setting.b) if value is not None]
    if any(len(value) > _SETTING_MAX or "\n" in value for value in values):
        return str(setting)
    if len(values) == 2:
        return f"{setting} {' → '.join(values)}"
    return f"{setting} ({values[0]} only in {'b' if setting.a is None else 'a'})" if values else ""


def listed(things: Sequence[str]) -> str:
    """Return the first things with commas, each once, and how many more there are."""
    unique = list(dict.fromkeys(things))
    more = len(unique) - NAMED_MAX
    return ", ".join(unique[:NAMED_MAX]) + (f" and {more} more" if more > 0 else "")


def _thing(message: MessageDifference) -> str:
    label = _label(message)
    if message.presence == "both":
        if message.note:
            return f"parameter {message.note}"
        fields = field_text(message.fields, message.more_fields)
        return f"{label}: {fields}" if fields else label
    if message.kind is OutputKind.LOG and message.preview:
        label = f"log {message.preview}"
    if message.note.endswith((" in a", " in b")):
        return f"{label} {message.note}"
    if message.note:
        label = f"{label}: {message.note}"
    return f"{label}{_IN_ONE[message.presence]}"


def _label(message: MessageDifference) -> str:
    return f"{_LABELS.get(message.kind, '') if message.kind else ''}{message.topic}"


def _and(things: Sequence[str]) -> str:
    unique = list(dict.fromkeys(things))
    if len(unique) > NAMED_MAX:
        return f"{', '.join(unique[:NAMED_MAX])} and {len(unique) - NAMED_MAX} more"
    return " and ".join(filter(None, (", ".join(unique[:-1]), unique[-1])))
