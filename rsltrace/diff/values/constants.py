"""What a message type calls the values of a field: ``STATUS_SUCCEEDED → STATUS_ABORTED``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rsltrace.diff.result.fields import FieldDifference

NAMED = " → "
Definition = tuple[Sequence[tuple[str, str, object]], Sequence[tuple[str, tuple[object, object]]]]


def with_names(
    found: FieldDifference, name: str, a: object, b: object, definition: Definition
) -> FieldDifference:
    """Return a difference of a whole number with the names of both values, if both have one.

    ``definition`` is what rosbags knows of the message type: its constants, its fields.
    """
    if isinstance(a, bool) or not isinstance(a, int) or not isinstance(b, int) or found.note:
        return found
    constants = _constants_of(name, definition)
    names = [[n for n, value in constants if value == wanted] for wanted in (a, b)]
    if any(len(of_one) != 1 for of_one in names):
        return found
    return replace(found, note=NAMED.join(of_one[0] for of_one in names))


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
