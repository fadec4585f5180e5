"""Format what the prompt prints: positions, values and source lines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsltrace.trace.model.texts import (
    counted,
    format_duration,
    format_seconds,
    printable,
    shortened,
)
from rsltrace.trace.words.entities import flag_names

if TYPE_CHECKING:
    from rsltrace.debug.checkpoints import Breakpoint, RunPosition, StopReport

_CELL_MAX = 60
_DID_MAX = 160

_ENDS = ("senders", "receivers")
_WHY = {
    "end": "the run is over",
    "begin": "this is the beginning of the run",
    "paused": "interrupted",
    "diverged": "the run has diverged",
}


def stopped_lines(stopped: StopReport) -> Iterator[str]:
    if stopped.breakpoint is not None:
        number, text = stopped.breakpoint.number, stopped.breakpoint.text
        more = f": {stopped.text}" if stopped.text and stopped.text != text else ""
        yield printable(f"breakpoint {number} ({text}){more}")
    elif stopped.reason in _WHY:
        text = f": {stopped.text}" if stopped.text else ""
        yield printable(f"{_WHY[stopped.reason]}{text}")
    elif stopped.text:
        yield printable(stopped.text)
    yield position_line(stopped.position)


def position_line(position: RunPosition) -> str:
    """Return the last event, or (with an arrow) the one that is about to run."""
    if position.is_next:
        what = _event(position.next or {})
        return printable(f"-> event {position.index}  {position.seconds}  {what}")
    if position.event is None:
        return f"   nothing has run yet  {position.seconds}"
    return _ended(position.event)


def where_lines(position: RunPosition) -> Iterator[str]:
    yield position_line(position)
    event = position.event
    if event is None:
        return
    if position.is_next:
        yield _ended(event)
    if event.get("cause_event") is not None:
        nth = "" if event["kind"] == "resume" else f", its output {event['cause_output']}"
        yield f"   caused by event {event['cause_event']}{nth}"
    hashes = [("chain", event.get("chain_hash")), ("state", event.get("state_hash"))]
    known = (f"{name} hash {value}" for name, value in hashes if value and set(value) != {"0"})
    yield printable(f"   {', '.join(known)}")


def found_lines(position: RunPosition) -> Iterator[str]:
    """Yield an event that was searched for, and how to go there."""
    yield position_line(position)
    before = f"goto {position.index - 1} before it" if position.index else "step runs it"
    yield f"   goto {position.index} stands after it, {before}"


def _ended(event: Mapping[str, Any]) -> str:
    did = list(event.get("did", ()))
    outputs = f"  -> {shortened(', '.join(map(str, did)), _DID_MAX)}" if did else ""
    flags = "".join(f"  [{flag}]" for flag in flag_names(int(event.get("flags", 0))))
    stamp = format_seconds(event["stamp_ns"])
    return printable(f"   event {event['index']}  {stamp}  {_event(event)}{outputs}{flags}")


def _event(event: Mapping[str, Any]) -> str:
    """Name the node and the callback: ``/ekf: subscription /scan``."""
    kind = str(event.get("kind", "")).replace("_", " ")
    entity = str(event.get("entity") or "")
    of = str(event.get("entity_kind") or "")
    what = f"{kind} {entity}".strip() if of in ("", kind) else f"{of} {entity} ({kind})"
    node = str(event.get("node") or "")
    return f"{node}: {what}" if node else what


def breakpoint_lines(breakpoints: Sequence[Breakpoint]) -> Iterator[str]:
    if not breakpoints:
        yield "no breakpoints"
    for one in breakpoints:
        yield printable(f"{one.number:>3}  {one.text}")


def value_lines(value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        yield from _mapping(value, "")
    elif isinstance(value, (list, tuple)):
        yield from _listed(value, "")
    else:
        yield printable(_cell("", value))


def queue_lines(queues: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the queues that hold something, and how many are empty."""
    full = [one for one in queues if one.get("waiting")]
    if full:
        yield from _table(full)
    where = "nothing waits in the other" if full else "nothing waits in"
    yield f"{where} {counted(len(queues) - len(full), 'queue')}"


def graph_lines(graph: Mapping[str, Any]) -> Iterator[str]:
    for node in graph.get("nodes", ()):
        timers = "".join(f", {name} every {format_duration(ns)}" for name, ns in node["timers"])
        yield printable(f"node {node['name']}  {node['type']}{timers}")
    for link in graph.get("links", ()):
        ends = [", ".join(end["node"] for end in link[key]) or "-" for key in _ENDS]
        yield printable(f"{link['kind']} {link['name']}  {link['type']}  {' -> '.join(ends)}")
    for problem in graph.get("problems", ()):
        yield printable(f"! {problem}")


def checkpoint_lines(found: Mapping[str, Any]) -> Iterator[str]:
    if found.get("why_not"):
        yield printable(f"no copy can be made: {found['why_not']}")
    if found["indices"]:
        yield f"before event {', '.join(map(str, found['indices']))}"
        yield f"{found['bytes'] / (1 << 20):.1f} MiB together (proportional set size)"


def _mapping(value: Mapping[str, Any], indent: str) -> Iterator[str]:
    if not value:
        yield f"{indent}none"
    width = max((len(str(name)) for name in value), default=0)
    for name, item in value.items():
        if isinstance(item, Mapping) and item:
            yield printable(f"{indent}{name}:")
            yield from _mapping(item, f"{indent}  ")
        elif isinstance(item, (list, tuple)) and any(isinstance(i, Mapping) for i in item):
            yield printable(f"{indent}{name}:")
            yield from _listed(item, f"{indent}  ")
        else:
            yield printable(f"{indent}{name:<{min(width, 40)}}  {_cell(str(name), item)}")


def _listed(value: Sequence[Any], indent: str) -> Iterator[str]:
    if not value:
        yield f"{indent}none"
    elif all(isinstance(item, Mapping) for item in value):
        yield from (f"{indent}{line}" for line in _table(value))
    else:
        for item in value:
            yield from (f"{indent}{line}" for line in str(_cell("", item)).splitlines())


def _table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    names = list(dict.fromkeys(name for row in rows for name in row))
    titles = [name.removesuffix("_ns").replace("_", " ") for name in names]
    cells = [[printable(_cell(name, row.get(name, ""))) for name in names] for row in rows]
    cells = [[shortened(cell, _CELL_MAX) for cell in row] for row in cells]
    widths = [max(map(len, column)) for column in zip(titles, *cells, strict=True)]
    for row in (titles, *cells):
        padded = (f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True))
        yield "  ".join(padded).rstrip()


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name.endswith("_ns") and isinstance(value, int):
        return format_duration(value) if name == "period_ns" else format_seconds(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_cell(str(key), item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_cell(name, item) for item in value)
    return str(value)


def source_lines(source: Mapping[str, Any] | None) -> Iterator[str]:
    if source is None:
        yield "there is no Python source for this event"
        return
    file = Path(source["file"])
    near = file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file
    yield printable(f"{source['name']}, {near}:{source['line']}")
    lines = source.get("lines") or []
    if not lines:
        yield "(its source is not available)"
    first = int(source["line"])
    width = len(str(first + len(lines)))
    at = source.get("at")
    sign = "" if at is None else "   "
    for number, line in enumerate(lines, first):
        yield printable(f"{'-> ' if number == at else sign}{number:>{width}}  {line}".rstrip())
