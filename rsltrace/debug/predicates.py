"""Conditions as the engine asks them: the event under way, in the form that conditions know."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

from rsltrace.debug.conditions.names import Names
from rsltrace.debug.conditions.text import parse_condition
from rsltrace.debug.conditions.view import Sent
from rsltrace.model.event import EventKind, OutputKind
from rsltrace.model.finding import Finding
from rsltrace.words.logs import parse_log

_MESSAGES = (OutputKind.MESSAGE, OutputKind.REQUEST, OutputKind.RESPONSE)


class _Output(Protocol):
    @property
    def kind(self) -> OutputKind: ...
    @property
    def name(self) -> str: ...
    @property
    def hash(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def data(self) -> bytes | str | None: ...


class View(Protocol):
    """What the engine shows of an event that is about to run (``is_next``) or has just ended."""

    @property
    def index(self) -> int: ...
    @property
    def is_next(self) -> bool: ...
    @property
    def now_ns(self) -> int: ...
    @property
    def kind(self) -> EventKind: ...
    @property
    def entity_id(self) -> int: ...
    @property
    def entity(self) -> str: ...
    @property
    def node(self) -> str: ...
    @property
    def message(self) -> Any: ...
    @property
    def output_hash(self) -> int: ...
    @property
    def outputs(self) -> Iterable[_Output]: ...
    @property
    def findings(self) -> Sequence[Finding]: ...
    def nodes(self) -> Mapping[str, object]: ...


class Seen:
    """An event of the engine, as conditions and expressions see it."""

    def __init__(self, view: View) -> None:
        self._view = view

    @property
    def index(self) -> int:
        """Its number, counted from 0."""
        return self._view.index

    @property
    def stamp_ns(self) -> int:
        """Simulated time."""
        return self._view.now_ns

    @property
    def kind(self) -> int:
        """Its ``EventKind``."""
        return self._view.kind

    @property
    def entity(self) -> int:
        """The id of what runs."""
        return self._view.entity_id

    @property
    def entity_name(self) -> str:
        """Its name: a topic, a service, a timer's callback."""
        return self._view.entity

    @property
    def node(self) -> str:
        """The full name of its node, empty for the run itself."""
        return self._view.node

    @property
    def output_hash(self) -> int:
        """The hash of its outputs; of an event that is about to run, 0."""
        return 0 if self._view.is_next else self._view.output_hash

    def received(self) -> tuple[str, object] | None:
        """Return topic (or service) and message of its input, None if it has no message."""
        message = self._view.message
        return None if message is None else (self._view.entity, message)

    def sent(self) -> Sequence[Sent]:
        """Return its outputs, in order; of an event that is about to run, none."""
        return [] if self._view.is_next else [_sent(one) for one in self._view.outputs]

    def findings(self) -> Sequence[str]:
        """Return what the guard found in it; before it runs, nothing."""
        return [] if self._view.is_next else [one.source.value for one in self._view.findings]

    def nodes(self) -> Mapping[str, object]:
        """Return the nodes there are, by their full names."""
        return self._view.nodes()


class Predicate:
    """A condition that the engine asks. ``before`` and ``after`` say when it wants to be.

    ``why`` says what it has found; ``note`` why it could not be evaluated so far, if so.
    """

    def __init__(self, text: str, names: Names | None) -> None:
        condition = parse_condition(text, names)
        self.before = condition.before
        self.after = condition.after
        self.why = ""
        self._arm = condition.arm

    def begin(self, view: View) -> None:
        """Count from here on."""
        self._armed = self._arm(Seen(view))

    def __call__(self, view: View) -> bool:
        """Say whether it is true of an event.

        :raises ConditionError: it cannot be evaluated.
        """
        seen = Seen(view)
        self.why = self._armed.before(seen) if view.is_next else self._armed.after(seen)
        return bool(self.why)

    @property
    def note(self) -> str:
        """Why it could not be evaluated so far."""
        return self._armed.note


def compiled(text: str, names: Names | None = None) -> Predicate:
    """Return the condition that a text means.

    :raises ConditionError: it means none.
    """
    return Predicate(text, names)


def loaded_fields(interface: str) -> Mapping[str, str] | None:
    """Return the fields of an interface (``nav_msgs/msg/Odometry``) whose class is loaded; to look
    at a run must not import anything into it."""
    package, _, name = interface.partition("/")
    kind, _, name = name.partition("/")
    found = getattr(sys.modules.get(f"{package}.{kind}"), name, None)
    known = getattr(found, "get_fields_and_field_types", None)
    return None if known is None else dict(known())


def _sent(output: _Output) -> Sent:
    kind, data = output.kind, output.data
    content_hash = int(output.hash, 16)
    if kind is OutputKind.LOG and isinstance(data, bytes):
        log = parse_log(data)
        return Sent(kind, output.name, content_hash, log.text, log.level)
    if kind is OutputKind.EXCEPTION and isinstance(data, str):
        last = (data.strip().splitlines() or [""])[-1]
        return Sent(kind, output.name, content_hash, last)
    if kind in _MESSAGES and isinstance(data, bytes):
        type_name = output.type

        def message() -> object:
            return _decoded(type_name, data)

        return Sent(kind, output.name, content_hash, message=message)
    return Sent(kind, output.name, content_hash, data if isinstance(data, str) else "")


def _decoded(type_name: str, data: bytes) -> object:
    from rsltrace.doors.rclpy.wire.codec import codec_for
    from rsltrace.doors.rclpy.wire.interfaces import get_message_class

    return codec_for(get_message_class(type_name)).deserialize(data)
