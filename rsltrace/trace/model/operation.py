"""Small outputs of an event, recorded only as a hash: a timer was changed, a task made."""

from __future__ import annotations

import re
import struct

from rsltrace.trace.model.entity import Entity, EntityKind

# Entities that rclpy makes for every node: most of a run's, hardly ever of interest.

PARAMETER_EVENTS = "/parameter_events"
NODE_TOPICS = frozenset(("/rosout", PARAMETER_EVENTS))
NODE_SERVICES = frozenset(
    (
        "describe_parameters",
        "get_parameter_types",
        "get_parameters",
        "get_type_description",
        "list_parameters",
        "set_parameters",
        "set_parameters_atomically",
    )
)


def is_built_in(entity: Entity) -> bool:
    """Whether rclpy made ``entity`` by itself: publishers of logs and parameter events, parameter
    services."""
    if entity.kind is EntityKind.PUBLISHER:
        return entity.name in NODE_TOPICS
    return entity.kind is EntityKind.SERVICE and entity.name.rpartition("/")[2] in NODE_SERVICES


# YAML parsers take quadratic time for nested brackets.

NESTING_MAX = 100
_BRACKETS = re.compile(r"[][{}]")


def nested_too_deep(text: str) -> int:
    """Return where brackets are nested more than ``NESTING_MAX`` deep, -1 if nowhere."""
    depth = 0
    for found in _BRACKETS.finditer(text):
        depth = depth + 1 if found[0] in "[{" else max(depth - 1, 0)
        if depth > NESTING_MAX:
            return found.start()
    return -1


TIMER_CANCEL = 1
TIMER_RESET = 2
TIMER_PERIOD = 3
RESUMES_COROUTINE = 1  # of a task

pack_operation = struct.Struct("<Bq").pack
"""Packs an operation and a value in ns: a timer's next deadline, or its new period."""
