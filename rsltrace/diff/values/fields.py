"""Two decoded messages, field by field: what differs, and by how much.

Messages are rosbags' classes, as ``Trace.decode`` returns them: fields are attributes, arrays of
numbers numpy arrays, arrays of anything else lists. Values are compared bit for bit, so what this
module calls equal has equal canonical CDR.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, cast

import numpy as np

from rsltrace.diff.facts.evidence import FieldDifference, FieldNote, FieldNoteKind
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.values.globs import FieldRules
from rsltrace.diff.values.numbers import (
    array_text,
    diff_arrays,
    diff_numbers,
    number_text,
    same_number,
)
from rsltrace.trace.model.texts import NS_PER_S, PLACEHOLDERS, format_seconds, printable, shortened

WHOLE = "(whole)"
"""The path of a difference that belongs to no field: of the types, or of two plain values."""
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
Definition = tuple[Sequence[tuple[str, str, object]], Sequence[tuple[str, tuple[object, object]]]]

_ABSENT = "absent"
_SECONDS_MAX = 2.0**33
"""More than any two times are apart."""
_TEXT_MAX = 60
_WORDS_MAX = 10_000
_BETWEEN_WORDS = re.compile(r"[\s,;|&()\[\]{}'\"]+")
_TEXT_BEFORE = 20
_SORTED_MAX = 1000
_ITEM_MAX = 2000
_LIST_MAX = 80


def diff_messages(
    a: object, b: object, options: DiffOptions, *, limit: int = 20
) -> tuple[tuple[FieldDifference, ...], int]:
    """Return the fields in which ``a`` and ``b`` differ, and how many more than ``limit`` do.

    In the order of the message, but what no tolerance covers comes first: if the first one is
    within tolerance, all are. Fields that ``options.ignore`` names are left out, so the answer is
    empty when everything that differs is ignored. Times and durations are one field, in seconds.
    Plain values (the text of an exception, say) are compared as a message of one field.
    """
    found = sorted(field_differences(a, b, FieldRules(options)), key=_is_covered)
    return tuple(found[:limit]), max(len(found) - limit, 0)


def field_differences(a: object, b: object, rules: FieldRules) -> Iterator[FieldDifference]:
    """Yield the fields that differ, in the order of the message, as they are found."""
    return _differences("", a, b, "float64", rules)


def preview(message: object, width: int = 100) -> str:
    """Return a decoded message as one line of at most ``width`` characters."""
    text = ""
    for part in _preview_parts(message, top=True):
        text += part
        if len(text) > width:
            break
    return shortened(text, width)


def _is_covered(difference: FieldDifference) -> bool:
    return difference.within_tolerance


def fields_of(message: object) -> tuple[tuple[str, str, str], ...]:
    """Return (ROS name, attribute, type if it is a basic one) of a message's fields."""
    return _fields_of_class(cast(Hashable, type(message)))


def _definition(cls: Any) -> Any:
    definitions = getattr(cls.__init__, "__globals__", {}).get("FIELDDEFS", {})
    return definitions.get(getattr(cls, "__msgtype__", ""))


@lru_cache(maxsize=512)
def _fields_of_class(cls: Any) -> tuple[tuple[str, str, str], ...]:
    """Look at a message's class.

    rosbags keeps the types of the fields beside the class it generates, in the same module, and a
    float says no other way whether it was float32. The module is not to be found by its name,
    which the next one takes over.
    """
    definition = _definition(cls)
    attributes = {
        field.name: field
        for field in dataclasses.fields(cls)
        if field.name not in PLACEHOLDERS and not str(field.type).startswith("ClassVar")
    }
    if definition is None:
        return tuple((name, name, "float64") for name in attributes)
    found = []
    for name, (_, detail) in definition[1]:
        attribute = name if name in attributes else f"{name}_"  # rosbags' way with Python's words
        if attribute in attributes:
            base = detail[0] if isinstance(detail, tuple) and isinstance(detail[0], str) else ""
            found.append((name, attribute, base))
    return tuple(found)


def _is_message(value: object) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _type_of(message: object) -> str:
    return str(getattr(message, "__msgtype__", type(message).__name__))


def _differences(
    path: str, a: Any, b: Any, base: str, rules: FieldRules
) -> Iterator[FieldDifference]:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        if a.dtype != b.dtype:
            yield from _of_other_type(path, a, b, rules)
        elif not rules.ignored(path):
            found = diff_arrays(path, a, b, rules)
            if found is not None:
                yield found
    elif isinstance(a, list) and isinstance(b, list):
        yield from _list_differences(path, a, b, base, rules)
    elif _is_message(a) and _is_message(b):
        yield from _message_differences(path, a, b, rules)
    elif type(a) is not type(b):
        yield from _of_other_type(path, a, b, rules)
    elif isinstance(a, str):
        if a != b and not rules.ignored(path):
            yield _text_difference(path, a, b)
    elif not same_number(a, b) and not rules.ignored(path):
        yield diff_numbers(path or WHOLE, a, b, base, rules)


def _message_differences(path: str, a: Any, b: Any, rules: FieldRules) -> Iterator[FieldDifference]:
    type_a, type_b = _type_of(a), _type_of(b)
    if type_a != type_b:
        yield FieldDifference(
            path or WHOLE,
            printable(type_a),
            printable(type_b),
            notes=(FieldNote(FieldNoteKind.OTHER_TYPES),),
        )
    elif type_a in _TIMES:
        time_a, time_b = _nanoseconds(a), _nanoseconds(b)
        if time_a is not None and time_b is not None:
            yield from _time_difference(path, time_a, time_b, a, b, rules)
            return
    of_b = {name: attribute for name, attribute, _ in fields_of(b)}
    prefix = f"{path}." if path else ""
    for name, attribute, base in fields_of(a):
        value = getattr(a, attribute)
        other = of_b.pop(name, None)
        if other is not None:
            of_other = getattr(b, other)
            for found in _differences(prefix + name, value, of_other, base, rules):
                definition = _definition(type(a)) if isinstance(value, int) else None
                yield _with_names(found, name, value, of_other, definition) if definition else found
        elif not rules.ignored(prefix + name):
            yield FieldDifference(
                prefix + name,
                preview(value, 40),
                _ABSENT,
                notes=(FieldNote(FieldNoteKind.NO_SUCH_FIELD),),
            )
    for name, attribute in of_b.items():
        if not rules.ignored(prefix + name):
            text = preview(getattr(b, attribute), 40)
            yield FieldDifference(
                prefix + name, _ABSENT, text, notes=(FieldNote(FieldNoteKind.NO_SUCH_FIELD),)
            )


def _list_differences(
    path: str, a: list[Any], b: list[Any], base: str, rules: FieldRules
) -> Iterator[FieldDifference]:
    if len(a) != len(b) and not rules.ignored(path):
        common = min(len(a), len(b))
        places = range(common, min(common + 3, max(len(a), len(b))))
        extra = tuple((place, _item(a, place), _item(b, place)) for place in places)
        yield FieldDifference(
            path,
            f"{len(a)} items",
            f"{len(b)} items",
            notes=(FieldNote(FieldNoteKind.LENGTHS, len(a), len(b)),),
            first=extra,
        )
    elif 1 < len(a) <= _SORTED_MAX and rules.empty and _changed_places(a, b, base, rules):
        text_a, text_b = (preview(side, _LIST_MAX) for side in (a, b))
        yield FieldDifference(path, text_a, text_b, notes=(FieldNote(FieldNoteKind.SAME_ELEMENTS),))
        return
    for place, (one, other) in enumerate(zip(a, b, strict=False)):
        yield from _differences(f"{path}[{place}]", one, other, base, rules)


def _changed_places(a: list[Any], b: list[Any], base: str, rules: FieldRules) -> bool:
    """Whether two lists of one length have the same elements in another order."""
    texts_a, texts_b = ([preview(item, _ITEM_MAX) for item in side] for side in (a, b))
    if texts_a == texts_b or sorted(texts_a) != sorted(texts_b):
        return False
    order_a, order_b = (sorted(range(len(t)), key=t.__getitem__) for t in (texts_a, texts_b))
    # A text is not the whole of a long element.
    return all(
        next(_differences("", a[i], b[j], base, rules), None) is None
        for i, j in zip(order_a, order_b, strict=True)
    )


def _item(items: list[Any], place: int) -> str:
    return preview(items[place], 40) if place < len(items) else _ABSENT


def _of_other_type(path: str, a: Any, b: Any, rules: FieldRules) -> Iterator[FieldDifference]:
    """Two types that define one field differently; equal bits mean nothing there."""
    if not rules.ignored(path):
        yield FieldDifference(
            path or WHOLE,
            preview(a, 40),
            preview(b, 40),
            notes=(FieldNote(FieldNoteKind.OTHER_TYPES),),
        )


def _text_difference(path: str, a: str, b: str) -> FieldDifference:
    at = next(
        (i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b))
    )
    notes: tuple[FieldNote, ...]
    notes = (FieldNote(FieldNoteKind.SAME_WORDS),) if _is_reordered(a, b) else ()
    if max(len(a), len(b)) > _TEXT_MAX:
        notes = notes or (
            FieldNote(FieldNoteKind.FIRST_CHARACTER, at),
            FieldNote(FieldNoteKind.LENGTHS, len(a), len(b)),
        )
        a, b = _excerpt(a, at), _excerpt(b, at)
    return FieldDifference(path or WHOLE, _quoted(a), _quoted(b), notes=notes)


def _is_reordered(a: str, b: str) -> bool:
    """Whether two texts list the same in another order: they may have been put together from a
    set."""
    words_a, words_b = (_BETWEEN_WORDS.split(text[:_WORDS_MAX]) for text in (a, b))
    return words_a != words_b and sorted(words_a) == sorted(words_b)


def _excerpt(text: str, at: int) -> str:
    start = max(at - _TEXT_BEFORE, 0)
    end = start + _TEXT_MAX
    return f"{'…' if start else ''}{text[start:end]}{'…' if end < len(text) else ''}"


def _quoted(text: str) -> str:
    return '"' + printable(text.replace("\\", "\\\\").replace('"', '\\"')) + '"'


def _nanoseconds(time: Any) -> int | None:
    """Return a Time or Duration in nanoseconds, or None where it is not in its normal form."""
    if not 0 <= time.nanosec < NS_PER_S:
        return None
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def _time_difference(
    path: str, ns_a: int, ns_b: int, a: Any, b: Any, rules: FieldRules
) -> Iterator[FieldDifference]:
    if ns_a == ns_b:
        return
    differing = [name for name in ("sec", "nanosec") if getattr(a, name) != getattr(b, name)]
    if all(rules.ignored(f"{path}.{name}" if path else name) for name in differing):
        return
    distance_ns = abs(ns_a - ns_b)
    tolerance = rules.tolerance(path) if path else None
    covered = tolerance is not None and (
        distance_ns <= round(min(tolerance[0], _SECONDS_MAX) * NS_PER_S)
        or distance_ns <= tolerance[1] * max(abs(ns_a), abs(ns_b))
    )
    yield FieldDifference(
        path or WHOLE,
        format_seconds(ns_a),
        format_seconds(ns_b),
        distance_ns / NS_PER_S,
        within_tolerance=covered,
    )


def _preview_parts(value: Any, *, top: bool = False, base: str = "float64") -> Iterator[str]:
    """Yield the text of a value piece by piece, so that no more is made than is shown."""
    if isinstance(value, np.ndarray):
        yield array_text(value)
    elif isinstance(value, list):
        yield "["
        for place, item in enumerate(value):
            yield ", " if place else ""
            yield from _preview_parts(item, base=base)
        yield "]"
    elif _is_message(value):
        ns = _nanoseconds(value) if _type_of(value) in _TIMES else None
        if ns is not None:
            yield format_seconds(ns)
            return
        yield "" if top else "{"
        for place, (name, attribute, inner) in enumerate(fields_of(value)):
            yield f"{', ' if place else ''}{name}: "
            yield from _preview_parts(getattr(value, attribute), base=inner)
        yield "" if top else "}"
    elif isinstance(value, str):
        yield _quoted(value)
    elif isinstance(value, (bool, int, float)):
        yield number_text(value, base)
    else:
        yield printable(str(value))


# -- what a message type calls the values of a field: ``STATUS_SUCCEEDED → STATUS_ABORTED`` -------


def _with_names(
    found: FieldDifference, name: str, a: object, b: object, definition: Definition
) -> FieldDifference:
    """Return a difference of a whole number with the names of both values, if both have one.

    ``definition`` is what rosbags knows of the message type: its constants, its fields.
    """
    if isinstance(a, bool) or not isinstance(a, int) or not isinstance(b, int) or found.notes:
        return found
    constants = _constants_of(name, definition)
    names = [[n for n, value in constants if value == wanted] for wanted in (a, b)]
    if any(len(of_one) != 1 for of_one in names):
        return found
    note = FieldNote(FieldNoteKind.CONSTANTS, names[0][0], names[1][0])
    return replace(found, notes=(note,))


def _constants_of(field: str, definition: Definition) -> list[tuple[str, object]]:
    """Return the constants that are meant for a field: those that begin with its name, else all of
    its type where no other field is of that type."""
    constants, fields = definition
    types = {name: detail[0] for name, (_, detail) in fields if isinstance(detail, tuple)}
    kind = types.get(field)
    of_type = [(name, value) for name, type_name, value in constants if type_name == kind]
    prefix = f"{field.upper()}_"
    own = [(name, value) for name, value in of_type if name.startswith(prefix)]
    if own:
        return own
    return of_type if list(types.values()).count(kind) == 1 else []
