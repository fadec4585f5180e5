"""From an entry's ``stdin:`` to what is typed at its terminal."""

from __future__ import annotations

import re

from rsltrace.adapters.rclpy.entry import Typed
from rsltrace.errors import JobError
from rsltrace.job import Job, locate, showing_line

_ENTER = b"\r"
_KEY = re.compile(r"\x1b(?:\[[0-9;]*[ -/]*[@-~]|O[A-Za-z]|[^\x1b])?|.", re.DOTALL)
"""One key: a character, an escape sequence (arrows, function keys), or Alt and a character."""
_LINE_MAX = 4000


def typed_at(job: Job, index: int) -> list[Typed] | None:
    """Return what is typed at the terminal of an entry, None if it has none.

    :raises JobError: if a file cannot be read or has lines that no terminal takes.
    """
    stdin = job.nodes[index].stdin
    if stdin is None:
        return None
    typed: list[Typed] = []
    for number, item in enumerate(stdin):
        at_ns = item.at_ns
        if item.file is not None:
            lines = _lines(job, item.file, ("nodes", index, "stdin", number, "file"))
            parts: list[bytes | None] = [line + _ENTER for line in lines]
        elif item.line is not None:
            parts = [item.line.encode() + _ENTER]
        elif item.keys is not None:
            parts = [key.encode() for key in _KEY.findall(item.keys)]
        else:
            parts = [None]
        for part in parts:
            typed.append((at_ns, part))
            at_ns = None
    return typed


def _lines(job: Job, file: str, loc: tuple[str | int, ...]) -> list[bytes]:
    where = locate(job, loc)
    with showing_line(job, loc):
        try:
            lines = job.resolve(file).read_bytes().splitlines()
        except OSError as error:
            raise JobError(f"{file} cannot be read: {error.strerror}", where=where) from None
        for number, line in enumerate(lines, start=1):
            if len(line) > _LINE_MAX:
                raise JobError(
                    f"{file}:{number}: a terminal takes lines of at most {_LINE_MAX} bytes, this "
                    f"one has {len(line)}",
                    where=where,
                )
    return lines
