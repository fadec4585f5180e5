"""Files whose content and times are recorded (mode ``record``), and returned again."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from stat import S_ISDIR, S_ISREG
from sys import _getframe
from typing import Any

from rsltrace.guard import frames
from rsltrace.guard.call_reports import (
    UNREPORTED_MODULES,
    calling_module,
    is_following_links,
    is_installed_path,
)
from rsltrace.guard.frames import caller
from rsltrace.guard.guard import Guard, engaged, reporting_mode
from rsltrace.guard.process_ids import real_path
from rsltrace.guard.recorded.descriptors import (
    RawDescriptor,
    open_raw,
    recorded_descriptor,
    recorded_stat,
    recording_guard,
    unconnected_descriptor,
)
from rsltrace.guard.redirect import copy_of, redirect
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

_FILE = NondeterminismSource.FILE
_RECORD, _ALLOW = GuardMode.RECORD, GuardMode.ALLOW
_TERMINALS = "/dev/pts/"
_isatty = copy_of(os.isatty)
BYTES_MAX = 64 << 20


class _Content(io.BytesIO):
    """The content of a file when it was opened."""

    def __init__(self, content: bytes, name: str) -> None:
        super().__init__(content)
        self.name = name

    def writable(self) -> bool:
        """Return False, as for a file opened for reading."""
        return False


def _opening(real: Callable[..., Any]) -> Any:
    def open_(
        file: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
        closefd: bool = True,
        opener: Any = None,
    ) -> Any:
        file = real_path(file)
        frame = caller()
        text = (buffering, encoding, errors, newline)
        if isinstance(file, int):
            if frame.f_globals.get("__name__") == "subprocess":  # a pipe to a program to be started
                by_program = recording_guard(NondeterminismSource.PROCESS, frame)
                if by_program is not None:
                    by_program.descriptors.add(file, NondeterminismSource.PROCESS)
            if recorded_descriptor(file) is not None or _is_read_terminal(file, mode):
                raw = RawDescriptor(file, mode, name=file, closes=closefd)
                return open_raw(raw, mode, *text)
        elif opener is None and isinstance(mode, str) and not set(mode) & set("wax"):
            guard = recording_guard(NondeterminismSource.FILE, frame)
            if guard is not None and ("+" not in mode or _is_device(file)):
                return _recorded(guard, file, mode, text, real)
            if isinstance(file, str) and file.startswith(_TERMINALS) and engaged() is not None:
                number = os.open(file, _flags(mode))
                return open_raw(RawDescriptor(number, mode, name=file), mode, *text)
        return real(file, mode, *text, closefd, opener)

    return open_


def _is_read_terminal(fd: int, mode: str) -> bool:
    """Whether a file object of a terminal has to read with ``os.read``, which lets others go on
    meanwhile: a thread of the node may play the device at the other end."""
    return "r" in mode and fd > 2 and engaged() is not None and _isatty(fd)


def _flags(mode: str) -> int:
    return (os.O_RDWR if "+" in mode else os.O_RDONLY) | os.O_CLOEXEC


def _is_device(file: Any) -> bool:
    try:
        kind = _real_stat(file).st_mode
    except OSError:
        return True  # in a re-run it may be gone; a plain file cannot be opened in any case
    return not (S_ISREG(kind) or S_ISDIR(kind))


def _recorded(guard: Guard, file: Any, mode: str, text: Any, real: Callable[..., Any]) -> Any:
    """Return a recorded file object: of a device piece by piece, of a file as a whole."""
    name = os.fsdecode(file)
    fd: list[int] = []

    def content() -> Any:
        if _is_device(file) and os.path.exists(file):
            fd.append(os.open(file, _flags(mode)))
            return None
        with real(file, "rb") as plain:
            data: bytes = plain.read(BYTES_MAX + 1)
        if len(data) > BYTES_MAX:
            raise OSError(27, f"{name} is too large to be recorded")
        return data

    data = guard.record(NondeterminismSource.FILE, f"open({name!r})", content, _getframe(2))
    if data is not None:
        held = _Content(data, name)
        _, encoding, errors, newline = text
        return held if "b" in mode else io.TextIOWrapper(held, encoding, errors, newline)
    number = fd[0] if fd else unconnected_descriptor()
    guard.descriptors.drop(number)
    guard.descriptors.add(number, NondeterminismSource.FILE)
    return open_raw(RawDescriptor(number, mode, name=file), mode, *text)


_real_stat = copy_of(os.stat)


def _recording_stat(name: str, real: Callable[..., Any]) -> Any:
    def stat(path: Any, **options: Any) -> Any:
        guard = engaged()
        if guard is None:
            return real(path, **options) if options else real(path)
        try:
            frame = frames.next_caller()
        except frames.INTERRUPTED:
            frame = frames.lost_caller()
        user = guard.user_frame_of(frame)
        if user is None:
            return real(path, **options) if options else real(path)
        path = real_path(path)
        mode = guard.mode(_FILE, frame)
        if mode is _RECORD and not isinstance(path, int):
            call = f"{name}({os.fsdecode(path)!r})"
            return recorded_stat(guard, _FILE, call, lambda: real(path, **options), frame)
        value = real(path, **options) if options else real(path)
        if (
            mode is not _ALLOW
            and calling_module(frame) not in UNREPORTED_MODULES
            and not (S_ISDIR(value.st_mode) and is_following_links(frame))
        ):
            is_plain = type(path) is str and path[:1] == "/"
            call = _report_name_of_path(name, path) if is_plain else _report_name(name, path)
            if call:
                guard.report(_FILE, reporting_mode(mode), call, value, frame, _stat_text, user)
        return value

    return stat


def _report_name(name: str, path: Any) -> str:
    """Return the text of a call that accesses a file; empty if it is not reported."""
    return "" if is_installed_path(path) else f"{name}({repr(path)[:100]})"


_report_name_of_path = lru_cache(maxsize=4096)(_report_name)
"""The same for an absolute path, which does not depend on the working directory."""


def _stat_text(found: os.stat_result) -> str:
    return f"{found.st_size} bytes, changed {found.st_mtime_ns}"


@contextmanager
def recorded_files() -> Iterator[None]:
    """Record contents and times of files; report accesses to files that are not recorded."""
    with ExitStack() as stack:
        redirect(stack, io.open, _opening)
        for name in ("stat", "lstat"):
            redirect(stack, getattr(os, name), partial(_recording_stat, f"os.{name}"))
        yield
