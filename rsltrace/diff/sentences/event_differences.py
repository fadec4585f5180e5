"""In what two events differ, in one line: ``/cmd_vel x 0.8 → 0.0``. Reports and the viewer's rows
say it in these words."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest

from rsltrace.diff.facts.evidence import FieldDifference, MessageDifference, Presence
from rsltrace.diff.sentences.values import IN_ONE, no_fields_text
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import shortened
from rsltrace.trace.words.phrases import TURNS, number

_FIELDS_MAX = 5
_MESSAGES_MAX = 6
_VALUE_MAX, _BRIEF_MAX = 30, 12
_ALIKE = 3
"""Characters that are left of what two long values have in common before they differ."""
_CALLS = {OutputKind.REQUEST: "call", OutputKind.RESPONSE: "reply"}
_AS_IT_IS = 7
"""Numbers of so many characters are not rounded."""


def event_differences_text(found: Sequence[MessageDifference], *, brief: bool = False) -> str:
    """Return in what two events differ; ``brief``: without the topic where there is only one, which
    they sent: of what they received, it says that it is that."""
    # As rows of one run do, with what an event did first.
    found = sorted(found, key=lambda one: one.position < 0)
    texts = [_message_text(one, brief=brief) for one in found[:_MESSAGES_MAX]]
    if brief and len(texts) == 1 and found[0].position >= 0:
        return texts[0][1]
    if len(found) > _MESSAGES_MAX:
        texts.append(("…", f"{len(found) - _MESSAGES_MAX} more"))
    return ", ".join(f"{topic} {text}".strip() for topic, text in texts)


def _message_text(one: MessageDifference, *, brief: bool) -> tuple[str, str]:
    """Return what a message is of, and in what it differs."""
    is_log = one.kind is OutputKind.LOG
    topic = "log" if is_log else one.topic
    if one.kind in _CALLS:
        topic = f"{_CALLS[one.kind]} {topic}"
    if one.position < 0:
        topic = f"got {topic}"
    if one.presence is not Presence.BOTH and not one.fields:  # it has: what was drawn for it
        return topic, shortened(f"{one.preview} {IN_ONE[one.presence]}".strip(), 80)
    if not one.fields:
        return topic, no_fields_text(one) or "differs"
    fields = one.fields[:_FIELDS_MAX]
    names = [] if is_log else [field_name(field.path) for field in fields]
    if len(set(names)) < len(names):
        names = [field_name(field.path, whole=True) for field in fields]
    texts = [
        _field_text(name, field, brief=brief)
        for name, field in zip(names or [""] * len(fields), fields, strict=True)
    ]
    if len(one.fields) + one.more_fields > len(fields):
        texts.append("…")
    return topic, " ".join(texts)


def _field_text(name: str, field: FieldDifference, *, brief: bool) -> str:
    a, b = field.a, field.b
    if field.first:
        place, a, b = field.first[0]
        name += f"[{place}]"
    a, b = _short(a, b, _BRIEF_MAX if brief else _VALUE_MAX)
    return f"{name} {a} → {b}".strip()


def _short(a: str, b: str, most: int) -> tuple[str, str]:
    """Return two values as short as they can be and still differ, of about ``most`` characters."""
    for digits in range(4, 18):
        rounded = _rounded(a, digits), _rounded(b, digits)
        if rounded[0] != rounded[1] and not _exaggerates(rounded, (a, b)):
            # The end of a text that is too long is shown: of a large integer not its exponent.
            if not any("e" in one and len(one) > most for one in rounded):
                a, b = rounded
            break
    pairs = enumerate(zip_longest(a, b, fillvalue="0"))  # 2.5 is 2.500
    alike = next((place for place, (x, y) in pairs if x != y), min(len(a), len(b))) - _ALIKE
    if alike > 1 and max(len(a), len(b)) > most:
        a, b = (f"…{text[alike:]}" if len(text) > alike else text for text in (a, b))
    return shortened(a, most), shortened(b, most)


def _exaggerates(rounded: tuple[str, str], exact: tuple[str, str]) -> bool:
    """Return whether two numbers look much further from each other than they are, as 1.8125 and
    1.8125001 do in four digits: one may be rounded up and the other down."""
    try:
        shown, real = (abs(float(a) - float(b)) for a, b in (rounded, exact))
    except ValueError:
        return False
    return shown > 10 * real


def _rounded(text: str, digits: int) -> str:
    if len(text) <= _AS_IT_IS:
        return text
    try:
        return number(float(text), digits)
    except ValueError:
        return text


def field_name(path: str, *, whole: bool = False) -> str:
    """Return how a row calls a field: ``x``, of an angular velocity ``ω``; ``whole``: with the
    field it is in. A message that has nothing but ``data`` needs no name."""
    names = path.split(".")
    name = names[-1].rstrip("_")
    if "angular" in names[:-1]:
        name = TURNS.get(name, name)
    if path == "data":
        return ""
    return ".".join([*names[-2:-1], name]) if whole else name
