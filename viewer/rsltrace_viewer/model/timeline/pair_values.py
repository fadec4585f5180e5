"""In what the two events of a row differ, with both values: ``/cmd_vel x 0.8 → 0.0``. Read apart
from the rows, as values of one run are."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rsltrace.diff.facts.evidence import Presence
from rsltrace.diff.sentences.values import IN_ONE, no_fields_text
from rsltrace.errors import TraceError
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import printable, shortened
from rsltrace_viewer.model.timeline.message_values import field_name, number

if TYPE_CHECKING:
    from rsltrace.diff.facts.evidence import FieldDifference, MessageDifference
    from rsltrace.diff.traces.aligned_runs import AlignedRuns

Pair = tuple[int, int]
_KEPT = 4096
_FIELDS_MAX = 5
_MESSAGES_MAX = 6
_VALUE_MAX, _BRIEF_MAX = 30, 12
_ALIKE = 3
"""Characters that are left of what two long values have in common before they differ."""
_CALLS = {OutputKind.REQUEST: "call", OutputKind.RESPONSE: "reply"}
_AS_IT_IS = 7
"""Numbers of so many characters are not rounded."""


class PairValues:
    """The texts of the pairs of events that have been read so far."""

    def __init__(self, runs: AlignedRuns) -> None:
        self._runs = runs
        self._texts: OrderedDict[Pair, tuple[str, str]] = OrderedDict()

    def known(self, pair: Pair) -> tuple[str, str] | None:
        """Return in what a pair differs, and the same without the names of topics where there is
        only one; None if it has not been read. Empty: in nothing that was recorded."""
        return self._texts.get(pair)

    def read(self, pairs: Sequence[Pair]) -> Iterator[int]:
        """Read pairs, one at a time; yields how many are done."""
        for count, pair in enumerate(pairs, start=1):
            if pair not in self._texts:
                self._texts[pair] = self._read(pair)
                while len(self._texts) > _KEPT:
                    self._texts.popitem(last=False)
            yield count

    def _read(self, pair: Pair) -> tuple[str, str]:
        try:
            found = self._runs.differences(*pair)
            views = self._runs.view(pair[0], of_b=False), self._runs.view(pair[1], of_b=True)
        except TraceError as error:
            text = printable(f"unreadable: {error}")
            return text, text
        # As rows of one run do, with what an event did first.
        found = tuple(sorted(found, key=lambda one: one.position < 0))
        whole = self._text(found, brief=False)
        if not whole and views[0].state_hash != views[1].state_hash:
            whole = "another state afterwards"
        return printable(whole), printable(self._text(found, brief=True))

    def _text(self, found: Sequence[MessageDifference], *, brief: bool) -> str:
        texts = [_message_text(one, brief=brief) for one in found[:_MESSAGES_MAX]]
        if brief and len(texts) == 1:
            return texts[0][1]
        if len(found) > _MESSAGES_MAX:
            texts.append(("…", f"{len(found) - _MESSAGES_MAX} more"))
        return ", ".join(f"{topic} {text}".strip() for topic, text in texts)


def _message_text(one: MessageDifference, *, brief: bool) -> tuple[str, str]:
    """Return what a message is of, and in what it differs."""
    is_log = one.kind is OutputKind.LOG
    topic = "log" if is_log else "got" if one.position < 0 else one.topic
    if one.kind in _CALLS:
        topic = f"{_CALLS[one.kind]} {topic}"
    if one.presence is not Presence.BOTH:
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
    """Return two values as short as they can be told apart, in about so many characters each."""
    for digits in range(4, 18):
        rounded = _rounded(a, digits), _rounded(b, digits)
        if rounded[0] != rounded[1]:
            a, b = rounded
            break
    differs = (place for place, (x, y) in enumerate(zip(a, b, strict=False)) if x != y)
    alike = next(differs, min(len(a), len(b))) - _ALIKE
    if alike > 1 and max(len(a), len(b)) > most:
        a, b = f"…{a[alike:]}", f"…{b[alike:]}"
    return shortened(a, most), shortened(b, most)


def _rounded(text: str, digits: int) -> str:
    if len(text) <= _AS_IT_IS:
        return text
    try:
        return number(float(text), digits)
    except ValueError:
        return text
