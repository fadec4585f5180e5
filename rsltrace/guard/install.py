"""Install all replacements for the time of a run, and remove them afterwards."""

from __future__ import annotations

import ctypes
import datetime
import hashlib
import os
import platform
import random
import re
import resource
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar, Token
from functools import cached_property, partial
from types import (
    AsyncGeneratorType,
    BuiltinMethodType,
    CellType,
    CodeType,
    CoroutineType,
    FrameType,
    FunctionType,
    GeneratorType,
    MethodWrapperType,
)
from typing import Any
from weakref import CallableProxyType, ProxyType, ReferenceType

from rsltrace.guard.addresses import reported_hashes
from rsltrace.guard.call_reports import reported_calls
from rsltrace.guard.callers import is_never_user_code, module_of
from rsltrace.guard.frames import caller, replace_special_method
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.guard.libraries import present_import
from rsltrace.guard.loading import when_loaded
from rsltrace.guard.process_ids import real_id, real_path, virtual_id
from rsltrace.guard.recorded.descriptors import recorded_descriptors
from rsltrace.guard.recorded.files import recorded_files
from rsltrace.guard.recorded.polls import recorded_polls
from rsltrace.guard.recorded.processes import recorded_processes
from rsltrace.guard.recorded.sockets import recorded_sockets
from rsltrace.guard.redirect import redirect, replace_attribute
from rsltrace.guard.virtual.arrays import zeroed_arrays
from rsltrace.guard.virtual.clocks import virtual_clocks
from rsltrace.guard.virtual.processors import virtual_processors
from rsltrace.guard.virtual.randomness import virtual_randomness
from rsltrace.guard.virtual.set_order import ordered_sets
from rsltrace.trace.model.finding import GuardMode, NondeterminismSource

# Directory listings are sorted by name: a file system returns them in any order.

_NAMES_MAX = 20
"""The number of names of a listing that the trace keeps."""


class SortedDirectory:
    """The result of ``os.scandir``, sorted by name."""

    def __init__(self, entries: list[Any]) -> None:
        self._entries = iter(entries)

    def __iter__(self) -> SortedDirectory:
        return self

    def __next__(self) -> Any:
        return next(self._entries)

    def __enter__(self) -> SortedDirectory:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Return no more entries."""
        self._entries = iter(())


def _sorted_names(value: list[Any]) -> tuple[list[Any], list[Any]]:
    names = sorted(value, key=os.fsencode)
    return names, names


def _sorted_scan(value: Any) -> tuple[SortedDirectory, list[Any]]:
    with value:
        entries = sorted(value, key=lambda entry: os.fsencode(entry.name))
    return SortedDirectory(entries), [entry.name for entry in entries]


def _call(name: str, arguments: tuple[Any, ...]) -> str:
    path = arguments[0] if arguments else "."
    return f"os.{name}({os.fspath(path) if isinstance(path, os.PathLike) else path!r})"


def _names_text(names: list[Any]) -> str:
    """Describe a listing: how many names, and which; two runs may have found others."""
    texts = [os.fsdecode(name) for name in names]
    if not texts:
        return "no names"
    more = len(texts) - _NAMES_MAX
    if more <= 0:
        return f"{len(texts)} name{'' if len(texts) == 1 else 's'} ({', '.join(texts)})"
    digest = hashlib.sha256("\0".join(texts).encode(errors="surrogateescape")).hexdigest()[:16]
    return f"{len(texts)} names, SHA-256 {digest} ({', '.join(texts[:_NAMES_MAX])}, …)"


def _listing(
    name: str, arrange: Callable[[Any], tuple[Any, list[Any]]], real: Callable[..., Any]
) -> Any:
    call = f"os.{name}()"

    def listed(*arguments: Any, **options: Any) -> Any:
        value = real(*map(real_path, arguments), **options)
        guard = engaged()
        if guard is None:
            return value
        frame = caller()
        mode = guard.mode(NondeterminismSource.DIRECTORY, frame)
        if mode is GuardMode.VIRTUAL:
            arranged, names = arrange(value)
            guard.count_call(NondeterminismSource.DIRECTORY, call, frame)
            guard.note_answer(
                NondeterminismSource.DIRECTORY,
                _call(name, arguments),
                partial(_names_text, names),
                frame,
            )
            return arranged
        if mode is not GuardMode.ALLOW:
            shown = repr(value[:10]) if isinstance(value, list) else ""
            guard.report_user_call(NondeterminismSource.DIRECTORY, call, shown, frame)
        return value

    return listed


@contextmanager
def sorted_listings() -> Iterator[None]:
    """Sort the results of ``os.listdir`` and ``os.scandir``, and so of glob, pathlib and
    ``os.walk``."""
    with ExitStack() as stack:
        for name, arrange in (
            ("listdir", _sorted_names),
            ("scandir", _sorted_scan),
        ):
            redirect(stack, getattr(os, name), partial(_listing, name, arrange))
        yield


# Python's own modules cache answers for a whole process: ``tempfile`` its folder and sequence of
# names, ``platform`` the machine. A second run in the same process would get other names and miss
# findings. So each run begins with empty caches, each node has its own names and asks itself, and
# afterwards the old caches return.

_tempfile: Any = tempfile
_platform: Any = platform
_PLATFORM_CACHES: dict[str, tuple[str, Callable[[], object]]] = {
    "uname": ("_uname_cache", lambda: None),
    "platform": ("_platform_cache", dict),
    "freedesktop_os_release": ("_os_release_cache", lambda: None),
}
"""Functions of ``platform``, the name of each one's cache, and its initial value."""


class _RandomFileNames(_tempfile._RandomNameSequence):  # type: ignore[misc]
    """One node's names. Does not ask for the process id, which would be a finding."""

    @cached_property
    def rng(self) -> random.Random:
        return random.Random()


class _FileNameSequence:
    """Replaces ``tempfile``'s sequence of random names: each node has its own.

    That a name is taken, by what an earlier run has left, is a finding: this run uses another."""

    def __init__(self, real: Any) -> None:
        self._real = real

    def __iter__(self) -> _FileNameSequence:
        return self

    def __next__(self) -> str:
        guard = engaged()
        if guard is None:
            if self._real is None:
                self._real = _tempfile._RandomNameSequence()
            return str(next(self._real))
        names, frame = guard.streams.file_names, sys._getframe(1)
        if frame.f_locals.get("seq"):
            call = f"the taken name {frame.f_locals.get('file')!r}"
            guard.report_user_call(NondeterminismSource.FILE, call, True, frame)
        stream = guard.stream(frame)
        if stream not in names:
            names[stream] = _RandomFileNames()
        return str(next(names[stream]))


def _unreported(real: Callable[..., str]) -> Callable[..., str]:
    """One node finds the folder for all: neither its random stream nor its findings show it."""

    def default_folder(*arguments: Any) -> str:
        with engage(None):
            return real(*arguments)

    return default_folder


def _uncached(real: Any, cache: str, empty: Callable[[], object]) -> Any:
    """Ask the machine again each time: a library may have asked before."""

    def ask(*arguments: Any, **options: Any) -> Any:
        setattr(_platform, cache, empty())
        return real(*arguments, **options)

    return ask


@contextmanager
def fresh_module_caches() -> Iterator[None]:
    """Start with empty caches of Python's modules, and restore them afterwards."""
    with ExitStack() as stack:
        for name, (cache, empty) in _PLATFORM_CACHES.items():
            if hasattr(platform, cache):
                replace_attribute(stack, platform, cache, empty())
                replace_attribute(
                    stack, platform, name, _uncached(getattr(platform, name), cache, empty)
                )
        find = _tempfile._get_default_tempdir
        chosen = tempfile.tempdir
        if chosen is not None and chosen == find():
            chosen = None  # nobody has chosen it
        replace_attribute(stack, tempfile, "tempdir", chosen)
        replace_attribute(stack, tempfile, "_get_default_tempdir", _unreported(find))
        replace_attribute(
            stack, tempfile, "_name_sequence", _FileNameSequence(_tempfile._name_sequence)
        )
        yield


# ``os.getpid`` in user code: names, seeds and files made from it are the same in every run.

_CALL = "os.getpid()"
_LOGGING = "logging"
_ID_FUNCTIONS = (
    *("getpgid", "getsid", "getpriority", "setpriority", "pidfd_open"),
    *("sched_getparam", "sched_setparam", "sched_getscheduler", "sched_setscheduler"),
    "sched_rr_get_interval",
)
"""Functions of ``os`` that take a process id; adapters replace ``os.kill``."""

_PATH_FUNCTIONS = ("readlink", "access")
"""Functions of ``os`` that take a path and that nothing else redirects."""


def _getpid(real: Callable[[], int]) -> Callable[[], int]:
    def getpid() -> int:
        guard = engaged()
        if guard is None:
            return real()
        frame = caller()
        if is_never_user_code(frame):
            return real()
        mode = guard.mode(NondeterminismSource.PID, frame)
        shown = module_of(frame) == _LOGGING  # which puts it into every record
        if mode is GuardMode.VIRTUAL and (shown or guard.is_user(frame)):
            if not shown:
                guard.count_call(NondeterminismSource.PID, _CALL, frame)
            return virtual_id(guard)
        if shown:
            return real()
        if mode is GuardMode.RECORD and guard.is_user_call(frame):
            return int(guard.record(NondeterminismSource.PID, _CALL, real, frame))
        value = real()
        guard.report_user_call(NondeterminismSource.PID, _CALL, value, frame)
        return value

    return getpid


def _translating(meant: Callable[[Any], Any], real: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> Any:
        options = {name: meant(value) for name, value in options.items()}
        return real(*map(meant, arguments), **options)

    return call


@contextmanager
def own_process_ids() -> Iterator[None]:
    """Give each main its own process id, and accept it where a real one is expected."""
    with ExitStack() as stack:
        redirect(stack, os.getpid, _getpid)
        for name in _ID_FUNCTIONS:
            if hasattr(os, name):
                redirect(stack, getattr(os, name), partial(_translating, real_id))
        redirect(stack, resource.prlimit, partial(_translating, real_id))
        for name in _PATH_FUNCTIONS:
            redirect(stack, getattr(os, name), partial(_translating, real_path))
        yield


# ``<Robot object at 0x7f…>`` goes into log records, keys and sorted lists. For the time of a run
# ``__repr__`` of objects, functions, generators and others shows a number instead of the address;
# every type that inherits one of these looks it up by name.

_as_method = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)(
    ("PyInstanceMethod_New", ctypes.pythonapi)
)
_SHOWING_ADDRESSES = (
    *(object, FunctionType, GeneratorType, CoroutineType, AsyncGeneratorType),
    *(BuiltinMethodType, MethodWrapperType, CodeType, CellType, FrameType),
    *(ReferenceType, ProxyType, CallableProxyType, memoryview),
    *(ContextVar, Token, type(datetime.datetime_CAPI)),
    *(type(hashlib.sha256()), type(ctypes.byref(ctypes.c_int()))),
    ctypes._CFuncPtr,  # type: ignore[attr-defined]
)
_SHOWN_ADDRESS = re.compile(r"(?:\bat |@ |\()(0x[0-9a-f]{6,})")


def _numbered(real: Callable[[Any], str]) -> Callable[[Any], str]:
    def __repr__(self: Any, /) -> str:  # noqa: N807
        text = real(self)
        guard = engaged()
        if guard is None or not _SHOWN_ADDRESS.search(text) or present_import() is not None:
            return text  # an import takes no numbers of a node: the next run may need none
        frame = caller()
        if guard.mode(NondeterminismSource.ADDRESS, frame) is GuardMode.ALLOW:
            return text
        with engage(None):
            for obj in _shown_by(self):
                address = f"0x{id(obj):x}"
                if address in text:
                    text = text.replace(address, _address_text(guard, obj) or address)
            left = next((n for n in _SHOWN_ADDRESS.findall(text) if n[:4] != "0x52"), None)
        if left is not None:
            guard.shown.reported = left
            guard.report_user_call(
                NondeterminismSource.ADDRESS, f"text of {type(self).__qualname__}", left, frame
            )
        return text

    # numba's jitclass rejects a class that adds a function to ``object``.
    vars(__repr__)["__objclass__"] = getattr(real, "__objclass__", None)
    method: Callable[[Any], str] = _as_method(__repr__)
    return method


def _shown_by(obj: Any) -> Iterator[Any]:
    """Yield an object and another one whose address its text has, if it has one."""
    kind = type(obj)
    if kind in (BuiltinMethodType, MethodWrapperType):
        yield obj.__self__
    elif kind is CellType:
        yield obj
        with suppress(ValueError):  # it is empty
            yield obj.cell_contents
    elif kind is ReferenceType:
        yield obj
        yield obj()
    else:
        yield obj


def _address_text(guard: Guard, obj: Any) -> str | None:
    """Return what replaces an object's address: the node's number for it, in hexadecimal.

    Real addresses do not begin like that. None for an object that cannot be recognized later.
    """
    node = guard.context.node()
    number = guard.shown.number(node, obj)
    if number is None:
        return None
    return f"0x52{zlib.crc32(node.encode('utf-8', 'replace')) & 0xFFFF:04x}{number * 16:06x}"


@contextmanager
def numbered_texts() -> Iterator[None]:
    """Replace the methods that make texts with addresses."""
    with ExitStack() as stack:
        for kind in _SHOWING_ADDRESSES:
            replace_special_method(stack, kind, "__repr__", _numbered)
        when_loaded(stack, "_elementtree", partial(_number_elements, stack))
        yield


def _number_elements(stack: ExitStack) -> None:
    replace_special_method(stack, sys.modules["_elementtree"].Element, "__repr__", _numbered)


@contextmanager
def own_arguments() -> Iterator[None]:
    """Hide the words of the command from nodes; programs of the job get their own."""
    with ExitStack() as stack:
        for name in ("argv", "orig_argv"):
            replace_attribute(stack, sys, name, ["rsltrace"])
        yield


_REPLACEMENTS = (
    fresh_module_caches,
    virtual_clocks,
    virtual_randomness,
    zeroed_arrays,
    sorted_listings,
    numbered_texts,
    reported_hashes,
    ordered_sets,
    own_process_ids,
    own_arguments,
    reported_calls,
    virtual_processors,
    recorded_files,
    recorded_descriptors,
    recorded_sockets,
    recorded_polls,
    recorded_processes,
)

_user_count = 0
_stack = ExitStack()


@contextmanager
def installed() -> Iterator[None]:
    """Install the replacements; the last run to leave removes them."""
    global _user_count, _stack
    if _user_count == 0:
        with ExitStack() as stack:
            for replacement in _REPLACEMENTS:
                stack.enter_context(replacement())
            _stack = stack.pop_all()
    _user_count += 1
    try:
        yield
    finally:
        _user_count -= 1
        if _user_count == 0:
            _stack.close()
