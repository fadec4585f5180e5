"""Events as titles and as parts of sentences."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.texts import format_seconds, printable

if TYPE_CHECKING:
    from rsltrace.trace.reader import Trace
    from rsltrace.trace.words.entities import EntityKey


_COLUMN_MAX = 60


def table(
    rows: Iterable[Sequence[str]],
    *,
    right: frozenset[int] = frozenset(),
    width: int | None = None,
    optional: Sequence[int] = (),
) -> list[str]:
    """Return ``rows`` as lines with aligned columns, two spaces between them.

    ``right`` has the columns that are aligned to the right. No line ends in spaces. A cell that is
    very long, unlike most, pushes the rest of its line to the right, not all. If lines are longer
    than ``width``, the ``optional`` columns are left out, one after the other.
    """
    cells = [list(row) for row in rows]
    widths = {place: _width(column) for place, column in enumerate(zip(*cells, strict=True))}
    for place in optional:
        if width is not None and sum(widths.values()) + 2 * (len(widths) - 1) > width:
            del widths[place]
    lines = []
    for row in cells:
        padded = [
            row[place].rjust(size) if place in right else row[place].ljust(size)
            for place, size in widths.items()
        ]
        lines.append("  ".join(padded).rstrip())
    return lines


def _width(column: Sequence[str]) -> int:
    lengths = sorted(map(len, column))
    usual = lengths[len(lengths) // 2]
    longest = 2 * usual if usual > _COLUMN_MAX else _COLUMN_MAX
    return max((length for length in lengths if length <= longest), default=0)


_ACTION = "/_action/"
_PARTS = {
    "send_goal": "goal",
    "get_result": "result",
    "cancel_goal": "cancelling",
    "feedback": "feedback",
    "status": "status",
}
"""Words for the services and topics of an action."""


def event_title(kind: EventKind, entity: EntityKey) -> str:
    """Return ``/filter: subscription /scan``, with what else ran: ``/filter: … (resume)``."""
    text = printable(str(entity)).rstrip()
    word = kind.label.replace("_", " ")
    return text if word in text else f"{text} ({word})"


def event_phrase(kind: EventKind, entity: EntityKey) -> str:
    """Return what ran, as part of a sentence: ``subscription /scan of /filter``."""
    name = entity.name
    if kind is EventKind.CONSTRUCT:
        return f"the constructor of {name}" if name else "the construction"
    if kind is EventKind.BAG:
        return f"the bag's message on {name}"
    if kind is EventKind.OUTSIDE:
        published = entity.kind == EntityKind.PUBLISHER.label
        return f"the message from outside on {name}" if published else "what outside did"
    if kind is EventKind.FAULT:
        return f"the fault of {name}"
    if kind is EventKind.SHUTDOWN:
        return f"the end of {name or 'the run'}"
    if kind is EventKind.CLOCK_JUMP:
        return "the jump of the clock to the start"
    number = f" (number {entity.ordinal + 1} of that name)" if entity.ordinal else ""
    owner = f" of {entity.node}" if entity.node else ""
    action, _, part = name.rpartition(_ACTION)
    what = entity.kind if kind in (EventKind.TASK, EventKind.RESUME) else kind.label
    if part in _PARTS:
        name, what = f"{action} ({_PARTS[part]})", "action"
    what = what.replace("_", " ")
    if kind is EventKind.CLIENT:
        what = f"the response of{' action' if part in _PARTS else ''}"
    elif kind is EventKind.TASK:
        what = f"a task of {what}"
    elif kind is EventKind.RESUME:
        what = f"the resumed {what}"
    return f"{what} {name}{number}{owner}"


def seconds_text(stamp_ns: int) -> str:
    """Return a time in seconds without the zeros at its end: ``1.5``, ``2.0``."""
    text = format_seconds(stamp_ns).rstrip("0")
    return f"{text}0" if text.endswith(".") else text


def at_time(stamp_ns: int) -> str:
    """Return a time as part of a sentence: ``at 1.5 s``."""
    return f"at {seconds_text(stamp_ns)} s"


def as_sentence(text: str) -> str:
    """Return a text with a capital letter and a full stop."""
    text = printable(text).strip()
    text = text[:1].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else f"{text}."


def notes_on(trace: Trace) -> Iterator[str]:
    """Yield what whoever reads results from a trace must know: how far a truncated one goes."""
    if not trace.complete:
        end = seconds_text(trace.end_ns - trace.start_ns)
        has = f"only the first {trace.event_count} events, to {end} s"
        yield (
            f"{trace.name} is truncated (its run was killed, or still runs): it has "
            f"{has if trace.event_count else 'no events'}"
        )


def exception_of(traceback: str) -> str:
    """Return the type and message of the exception that a traceback ends with, in one line."""
    lines = traceback.splitlines()
    frames = [at for at, line in enumerate(lines) if line.startswith(("Traceback (", "  File "))]
    after = lines[frames[-1] + 1 :] if frames else lines
    first = next((at for at, line in enumerate(after) if line and not line.startswith(" ")), 0)
    return " ".join(" ".join(after[first:]).split())


def path_word(path: str) -> str:
    """Return a path as a word of a command, never an option."""
    return shlex.quote(f"./{path}" if path.startswith("-") else path)


TURNS = {"x": "ωx", "y": "ωy", "z": "ω"}
"""The names of the parts of an angular velocity."""


def number(value: float, digits: int = 4) -> str:
    """Return a number in so many digits: ``0.31``, ``1.234e+06``."""
    text = f"{value:.{digits}g}"
    return "0" if text == "-0" else text
