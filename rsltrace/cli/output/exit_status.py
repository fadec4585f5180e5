"""The exit status of the command, kept whatever becomes of the streams that it prints to.

What cannot be written to stdout is an error, since somebody wanted it; what cannot be said on
stderr is not, since the status says it, too.
"""

from __future__ import annotations

import io
import os
import sys
import traceback
from collections.abc import Callable
from typing import Any

import click

from rsltrace.errors import EXIT_USAGE, RsltraceError
from rsltrace.terminal import tell

EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
"""128 + SIGPIPE, what a shell reports of any program whose reader went away."""


class _Stream(io.FileIO):
    """A standard stream that names itself in errors, or (``heedless``) has none."""

    reader_is_gone = False

    def __init__(self, number: int, title: str, *, heedless: bool) -> None:
        super().__init__(number, "w", closefd=False)
        self._title = title
        self._heedless = heedless

    def write(self, data: Any, /) -> int:
        """Write bytes; see the class."""
        try:
            return super().write(data) or 0
        except OSError as error:
            if self._heedless:
                return len(data)
            _Stream.reader_is_gone |= isinstance(error, BrokenPipeError)
            raise OSError(error.errno, error.strerror, self._title) from None


def open_standard_streams() -> None:
    """Make stdout and stderr ones that any character, and any trouble, can be written to.

    Those that whoever started us has closed lead nowhere. (Python has None for them, and the next
    file that is opened, the trace, would get their number, for all that writes below Python.)
    """
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            _lead_nowhere(number)
        elif not isinstance(stream, io.TextIOWrapper) or stream.fileno() != number:
            continue  # somebody else's, who calls us
        _open(number, name, stream)


def reopen_standard_streams() -> None:
    """Open those again that a node has closed; their descriptors are not."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and stream.closed:
            _open(number, name, stream)


def _open(number: int, name: str, stream: io.TextIOWrapper | None) -> None:
    raw = _Stream(number, f"standard {name[3:]}put", heedless=name == "stderr")
    opened = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=getattr(stream, "encoding", "utf-8"),
        errors="backslashreplace",
        line_buffering=getattr(stream, "line_buffering", True),
        write_through=getattr(stream, "write_through", False),
    )
    setattr(sys, name, opened)


def _lead_nowhere(number: int) -> None:
    devnull = os.open(os.devnull, os.O_WRONLY)
    if devnull != number:
        os.dup2(devnull, number)
        os.close(devnull)


def status_of(command: Callable[[], object]) -> int:
    """Run a command and return its status; the one place where an error becomes a message."""
    try:
        status = command()
        sys.stdout.flush()  # here, where a reader that went away is no traceback
    except SystemExit as end:
        status = end.code
        if status == 1 and _Stream.reader_is_gone:  # so click ends then
            _forget_output()
            status = EXIT_BROKEN_PIPE
    except RsltraceError as error:
        status = _failed(str(error), error.exit_code)
    except click.ClickException as error:
        shown = io.StringIO()
        error.show(shown)
        tell(shown.getvalue(), end="")
        status = error.exit_code
    except (KeyboardInterrupt, click.Abort) as end:
        status = _interrupted(end)
    except OSError as error:
        status = status_without_output(error)
    except Exception:
        # Python's own status for a bug would be 1, which says of some commands that runs differ.
        tell(traceback.format_exc(), end="")
        status = EXIT_USAGE
    status = status if isinstance(status, int) else EXIT_USAGE if status else 0
    try:
        sys.stdout.flush()
    except OSError as error:
        status = status_without_output(error, status)
    except ValueError:
        pass  # somebody has closed it
    return status


def status_without_output(error: OSError, status: int = 0) -> int:
    """Say that a command could not write (or read) something, and return its status.

    A ``status`` that says that it failed anyway is kept.
    """
    _forget_output()
    if isinstance(error, BrokenPipeError):
        return status or EXIT_BROKEN_PIPE
    of = f": {error.filename}" if error.filename else ""
    return _failed(f"{error.strerror or error}{of}", status or EXIT_USAGE)


def _interrupted(end: BaseException) -> int:
    """Return 128 + the signal, if whoever raised the interrupt has said which it was."""
    cause = end.__cause__ if isinstance(end, click.Abort) else end
    told = cause.args[0] if cause is not None and cause.args else EXIT_INTERRUPTED
    return told if isinstance(told, int) else EXIT_INTERRUPTED


def _failed(message: str, status: int) -> int:
    tell(f"rsltrace: error: {message}")
    return status


def _forget_output() -> None:
    """Send what is still buffered to nowhere, or Python would fail on it again at exit."""
    try:
        _lead_nowhere(sys.stdout.fileno())
    except (OSError, ValueError):
        pass  # not a real file: nothing is flushed to it later either
