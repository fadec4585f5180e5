"""The text of the callback that an event ran, as the file has it now."""

from __future__ import annotations

import ast
import hashlib
from pathlib import Path, PurePosixPath

from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.format import METADATA_SOURCES
from rsltrace.trace.reader import Trace
from rsltrace.trace.words.code import code_file, code_places, output_places, places_text
from rsltrace_viewer.model.run import Run

_LINES_MAX = 400
_BYTES_MAX = 4 << 20


@dataclass(frozen=True, slots=True)
class CallbackCode:
    """The callback of an event: ``line`` is the number of the first of ``lines``, ``at`` that of
    the one at which it waits, ``sent`` those from which its outputs came. ``note`` says why there
    are none, or that they may not be those of the run."""

    file: str
    line: int
    name: str
    lines: tuple[str, ...]
    note: str = ""
    at: int | None = None
    sent: frozenset[int] = frozenset()


def source_of(run: Run, index: int) -> CallbackCode | None:
    """Return the callback of event ``index``; None where the trace names none.

    Raises TraceError, IndexError.
    """
    places = code_places(run.trace, run.event(index))
    if not places:
        return None
    place = places[0]
    found = code_file(run.trace, place)
    name, _, line = place.rpartition(":")
    if found is None:
        note = "not below this folder or that of the trace: open it where the job is"
        return CallbackCode(name, int(line) if line.isdecimal() else 1, place, (), note)
    path, first = found
    try:
        data = path.read_bytes()[:_BYTES_MAX]
    except OSError as error:
        return CallbackCode(
            str(path), first, place, (), f"cannot be read: {error.strerror or error}"
        )
    text = data.decode("utf-8", "replace")
    lines = text.splitlines()
    note = "" if _is_that_of(run.trace, name, data) else "changed since this run: it may be others"
    if first > len(lines):
        note = f"changed since this run: it has {len(lines)} lines now"
    if len(places) > 1:
        note = "; ".join(filter(None, (f"or it ran {places_text(places[1:])}", note)))
    last = min(_last_line(text, first), first + _LINES_MAX)
    sent = _lines_in(name, run, index)
    return CallbackCode(str(path), first, place, tuple(lines[first - 1 : last]), note, sent=sent)


def place_of_output(run: Run, index: int, number: int) -> tuple[Path, int] | None:
    """Return file and line from which an output of an event came; None if that is not known.

    Raises TraceError, IndexError.
    """
    places = output_places(run.trace, run.outputs(index)[number])
    return code_file(run.trace, places[0]) if len(places) == 1 else None


def _lines_in(name: str, run: Run, index: int) -> frozenset[int]:
    """Return the lines of a file from which the outputs of an event came."""
    places = (output_places(run.trace, output) for output in run.outputs(index))
    lines = (one[0].rpartition(":") for one in places if len(one) == 1)
    return frozenset(int(line) for file, _, line in lines if file == name and line.isdecimal())


def _is_that_of(trace: Trace, name: str, data: bytes) -> bool:
    """Whether a file is the one that ran; of one that the trace has no hash of, nobody knows."""
    known = trace.metadata(METADATA_SOURCES)
    module = ".".join(PurePosixPath(name).with_suffix("").parts).removesuffix(".__init__")
    recorded = known.get(module) or known.get(f"file:{name}")
    return recorded is None or recorded == hashlib.sha256(data).hexdigest()[:16]


def _last_line(text: str, first: int) -> int:
    """Return the last line of the function that begins at a line, its decorators included."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return first + 40
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef)):
            decorators = getattr(node, "decorator_list", [])
            begin = min([node.lineno, *(one.lineno for one in decorators)])
            if begin == first and not isinstance(node, ast.ClassDef):
                return node.end_lineno or first
    return first + 40
