"""An event as a condition sees it: the run's side says how to get at it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class SentOutput:
    """An output of an event.

    ``kind`` is an ``OutputKind``, ``name`` the topic or service of a message, ``hash`` covers the
    content. ``text`` is that of a log record (of ``level``, 30: warning) or the last line of an
    exception's traceback. ``message`` decodes the message, if it is one.
    """

    kind: int
    name: str
    hash: int
    text: str = ""
    level: int = 0
    message: Callable[[], object] | None = None


class PausedRun(Protocol):
    """A run that stands still. ``stamp_ns`` is simulated time, ``start_ns`` that at which the run
    started."""

    @property
    def start_ns(self) -> int:
        """The simulated time at which the run started."""

    @property
    def stamp_ns(self) -> int:
        """The simulated time now."""

    def nodes(self) -> Mapping[str, object]:
        """Return the nodes there are, by their full names."""


class EventView(PausedRun, Protocol):
    """An event that is about to run, or has just ended."""

    @property
    def index(self) -> int:
        """Its number, counted from 0."""

    @property
    def kind(self) -> int:
        """Its ``EventKind``."""

    @property
    def entity(self) -> int:
        """The id of what runs."""

    @property
    def entity_name(self) -> str:
        """Its name: a topic, a service, a timer's callback."""

    @property
    def node(self) -> str:
        """The full name of its node, empty for the run itself."""

    @property
    def output_hash(self) -> int:
        """The hash of its outputs; of an event that is about to run, 0."""

    def received(self) -> tuple[str, object] | None:
        """Return topic (or service) and message of its input, None if it has no message."""

    def sent(self) -> Sequence[SentOutput]:
        """Return its outputs, in order; of an event that is about to run, none."""

    def findings(self) -> Sequence[str]:
        """Return what the guard found in it (``clock``, ``random``); before it runs, nothing."""
