"""The exit status of the command, also when its output streams fail.

A failed write to stdout is an error. A failed write to stderr is ignored: the exit status says it.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable
from typing import Any

import click

from rsltrace.errors import EXIT_USAGE, NodeError, RsltraceError
from rsltrace.terminal import tell

EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
"""128 + SIGPIPE, what a shell reports of any program whose reader went away."""


class _StandardStream(io.FileIO):
    """A standard stream whose errors name it, or are ignored (``ignores_errors``)."""

    reader_is_gone = False

    def __init__(self, number: int, title: str, *, ignores_errors: bool) -> None:
        super().__init__(number, "w", closefd=False)
        self._title = title
        self._ignores_errors = ignores_errors

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data) or 0
        except OSError as error:
            if self._ignores_errors:
                return len(data)
            _StandardStream.reader_is_gone |= isinstance(error, BrokenPipeError)
            raise OSError(error.errno, error.strerror, self._title) from None


def open_standard_streams() -> None:
    """Replace stdout and stderr by streams that can write any character.

    Closed ones are opened on /dev/null: otherwise the trace would get their file descriptors, and
    native code that writes to stdout would write into it.
    """
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            _open_devnull(number)
        elif not isinstance(stream, io.TextIOWrapper) or stream.fileno() != number:
            continue  # replaced by the program that calls us
        _open(number, name, stream)


def reopen_standard_streams() -> None:
    """Reopen streams that a node has closed (their file descriptors stay open)."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and stream.closed:
            _open(number, name, stream)


def _open(number: int, name: str, stream: io.TextIOWrapper | None) -> None:
    raw = _StandardStream(number, f"standard {name[3:]}put", ignores_errors=name == "stderr")
    opened = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=getattr(stream, "encoding", "utf-8"),
        errors="backslashreplace",
        line_buffering=getattr(stream, "line_buffering", True),
        write_through=getattr(stream, "write_through", False),
    )
    setattr(sys, name, opened)


def _open_devnull(number: int) -> None:
    devnull = os.open(os.devnull, os.O_WRONLY)
    if devnull != number:
        os.dup2(devnull, number)
        os.close(devnull)


_OF_UNIX = frozenset({"fcntl", "pty", "resource", "termios"})
"""Modules of Python that Windows has not."""
_NEEDS_UNIX = (
    "running nodes needs Linux or macOS (on Windows: WSL); diff, view and the like work here"
)


def status_of(command: Callable[[], object]) -> int:
    """Run a command, print its error and return its exit status."""
    try:
        status = command()
        sys.stdout.flush()  # inside the try: a closed pipe must not be a traceback
    except SystemExit as end:
        status = end.code
        if status == 1 and _StandardStream.reader_is_gone:  # click's exit status then
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
        status = interrupted_status(end)
    except OSError as error:
        status = status_without_output(error)
    except Exception as error:
        # Python's own status would be 1, which means of some commands that runs differ.
        if isinstance(error, ModuleNotFoundError) and error.name in _OF_UNIX:
            status = _failed(_NEEDS_UNIX, EXIT_USAGE)
        else:
            import traceback

            tell(traceback.format_exc(), end="")
            status = EXIT_USAGE
    status = status if isinstance(status, int) else EXIT_USAGE if status else 0
    try:
        sys.stdout.flush()
    except OSError as error:
        status = status_without_output(error, status)
    except ValueError:
        pass  # closed
    return status


def tell_error(error: RsltraceError) -> None:
    """Print an error, below the traceback if code of a node raised it."""
    if isinstance(error, NodeError) and error.traceback_text:
        tell(error.traceback_text.rstrip())
    tell(f"rsltrace: error: {error}")


def status_without_output(error: OSError, status: int = 0) -> int:
    """Print that a command could not read or write, and return its exit status.

    A ``status`` other than 0 is kept.
    """
    _forget_output()
    if isinstance(error, BrokenPipeError):
        return status or EXIT_BROKEN_PIPE
    of = f": {error.filename}" if error.filename else ""
    return _failed(f"{error.strerror or error}{of}", status or EXIT_USAGE)


def interrupted_status(end: BaseException) -> int:
    """Return the exit status that the interrupt carries (128 + the signal), else 130."""
    cause = end.__cause__ if isinstance(end, click.Abort) else end
    status = cause.args[0] if cause is not None and cause.args else EXIT_INTERRUPTED
    return status if isinstance(status, int) else EXIT_INTERRUPTED


def _failed(message: str, status: int) -> int:
    tell(f"rsltrace: error: {message}")
    return status


def _forget_output() -> None:
    """Discard buffered output, or Python would fail on it again at exit."""
    try:
        _open_devnull(sys.stdout.fileno())
    except (OSError, ValueError):
        pass  # not a file, so it is not flushed at exit
