"""Parameters of a node at some time, put together from what it announced on /parameter_events."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from rsltrace_viewer.model.run import Run

TOPIC = "/parameter_events"
_VALUE_FIELDS = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    5: "byte_array_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}
_MESSAGES_MAX = 20_000
"""So many announcements are read; a node that sets parameters in a loop has more."""


def parameters_at(run: Run, node: str, stamp_ns: int) -> dict[str, object]:
    """Return the parameters of ``node`` at ``stamp_ns``, by name. Raises TraceError."""
    values: dict[str, object] = {}
    for stamp, owner, changes in _announced(run):
        if stamp > stamp_ns:
            break
        if owner == node:
            for name, value in changes:
                if value is None:
                    values.pop(name, None)
                else:
                    values[name] = value
    return dict(sorted(values.items()))


@lru_cache(maxsize=4)
def _announced(run: Run) -> tuple[tuple[int, str, tuple[tuple[str, object], ...]], ...]:
    """Return (stamp, node, changes) of all announcements; a value of None was undeclared."""
    found = []
    for stamp_ns, sequence, data in run.trace.messages(TOPIC):
        if sequence >= _MESSAGES_MAX:
            break
        message: Any = run.trace.decode(TOPIC, data)
        changes: list[tuple[str, object]] = [
            (parameter.name, _value(parameter.value))
            for parameter in (*message.new_parameters, *message.changed_parameters)
        ]
        changes += [(parameter.name, None) for parameter in message.deleted_parameters]
        found.append((stamp_ns, message.node, tuple(changes)))
    return tuple(found)


def _value(value: Any) -> object:
    return getattr(value, _VALUE_FIELDS.get(value.type, ""), "not set")
