"""One event of a trace as text, or the walk back through its causes. Runs in its own process.

python -m rsltrace.cli.mcp_server.event_page event|why TRACE INDEX FOLDERS SECTIONS
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from rsltrace_viewer.model.inspector.effects import effects_of
from rsltrace_viewer.model.inspector.event import inspect, summary_line
from rsltrace_viewer.model.inspector.message_tree import Line, Openness
from rsltrace_viewer.model.run import Run

from rsltrace.errors import EXIT_USAGE, RsltraceError, TraceError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.event import NO_EVENT, EventRecord
from rsltrace.trace.words.code import ELSEWHERE, code_file, code_places, output_places, places_text

_CAUSES_MAX = 30
_LINES_BEFORE, _LINES_AFTER = 1, 10
_PLACES_MAX = 3


def event_lines(run: Run, index: int, sections: Sequence[str]) -> Iterator[str]:
    """Yield what the viewer's inspector shows of an event."""
    *_, effects = effects_of(run, index)
    for line in inspect(run, index, Openness(set(sections)), effects):
        yield _text(line)


def _text(line: Line) -> str:
    closed = f"  (more: sections={json.dumps([line.path])})" if line.open is False else ""
    return f"{'  ' * line.depth}{line.label}  {line.value}{closed}".rstrip()


def cause_lines(run: Run, index: int) -> Iterator[str]:
    """Yield an event, what caused it, what caused that, and so on."""
    for _ in range(_CAUSES_MAX):
        event = run.event(index)
        place = places_text(code_places(run.trace, event))
        yield f"event {summary_line(run, index)}{f'  at {place}' if place else ''}"
        if event.cause_event == NO_EVENT:
            yield "no other event caused this one"
            return
        index = event.cause_event
    yield f"… caused by event {index}: ask for that one"


def code_lines(run: Run, event: EventRecord, folders: Sequence[Path]) -> Iterator[str]:
    """Yield the source of an event's callback and the lines it sent from, as the files are now."""
    places = code_places(run.trace, event)
    for output in run.outputs(event.index):
        places += output_places(run.trace, output)
    for place in list(dict.fromkeys(places))[:_PLACES_MAX]:
        if place != ELSEWHERE:
            yield f"code {place}"
            yield from _source(run, place, folders)


def _source(run: Run, place: str, folders: Sequence[Path]) -> Iterator[str]:
    """A trace says where to look, so only Python files below the folders are read."""
    found = code_file(run.trace, place)
    if found is None:
        return
    path, number = found[0].resolve(), found[1]
    if path.suffix != ".py" or not any(path.is_relative_to(folder) for folder in folders):
        return
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    first = max(number - _LINES_BEFORE, 1)
    for at, text in enumerate(lines[first - 1 : number + _LINES_AFTER], first):
        yield f"  {'>' if at == number else ' '} {at:>4}  {text}"


def main(words: Sequence[str]) -> int:
    """Print a page."""
    form, trace, index, folders, sections = words
    try:
        run = Run.open(trace)
        number = int(index)
        if not 0 <= number < run.count:
            raise TraceError(f"{run.name} has the events 0 to {run.count - 1}, not {number}")
        if form == "why":
            lines = cause_lines(run, number)
        else:
            lines = event_lines(run, number, json.loads(sections))
        for line in lines:
            say(line)
        for line in code_lines(run, run.event(number), [Path(one) for one in json.loads(folders)]):
            say(line)
    except (RsltraceError, OSError) as error:
        tell(f"rsltrace: error: {error}")
        return EXIT_USAGE
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
