"""One thread for Intel's TBB, in ``libtbb`` and wherever it is linked into an extension module.

TBB has no environment variable. It asks once, when it is first used, for how many processors the
calling thread may run on, and divides loops by that number even where a single thread then runs
them: sums of floating-point numbers would differ between machines, too. So each copy of TBB is made
to ask while this thread may use one processor, and is held to one thread until the run is over.
"""

from __future__ import annotations

import _ctypes
import _imp
import ctypes
import mmap
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.machinery import EXTENSION_SUFFIXES
from types import ModuleType
from typing import Any, NamedTuple

from rsltrace.guard.callers import is_user_file
from rsltrace.guard.guard import engage
from rsltrace.guard.redirect import copy_of, redirect


class _Names(NamedTuple):
    """Functions of a generation of TBB, as the linker knows them."""

    processors: str
    hold: str
    release: str


_GENERATIONS = (
    _Names(  # oneTBB, from 2021 on
        "_ZN3tbb6detail2r115max_concurrencyEPKNS0_2d115task_arena_baseE",
        "_ZN3tbb6detail2r16createERNS0_2d114global_controlE",
        "_ZN3tbb6detail2r17destroyERNS0_2d114global_controlE",
    ),
    _Names(
        "_ZN3tbb19task_scheduler_init19default_num_threadsEv",
        "_ZN3tbb10interface914global_control15internal_createEv",
        "_ZN3tbb10interface914global_control16internal_destroyEv",
    ),
)
_TRACES = (b"N3tbb6detail2r1", b"N3tbb8internal")
"""Names of types of TBB's scheduler; they stay where its functions are hidden."""
_LOOKED_THROUGH_MAX = 64 << 20
_SUFFIXES = tuple(EXTENSION_SUFFIXES)

_dlopen: Callable[..., int] = copy_of(_ctypes.dlopen)  # type: ignore[arg-type]
_dlsym: Callable[..., int] = copy_of(_ctypes.dlsym)  # type: ignore[arg-type]
_may_use = copy_of(os.sched_getaffinity)  # type: ignore[arg-type]
_use = copy_of(os.sched_setaffinity)  # type: ignore[arg-type]

_without: set[str] = set()
"""Files of this process that are known to have no TBB."""


class _Control(ctypes.Structure):
    """TBB's ``global_control``: ``kind`` 0 is how many threads may run at most."""

    _fields_ = (
        ("value", ctypes.c_size_t),
        ("next", ctypes.c_void_p),
        ("kind", ctypes.c_int),
    )


class _Threads:
    """The copies of TBB that were met in a run. ``told`` takes a library and what is wrong."""

    def __init__(self, stack: ExitStack, told: Callable[[str, str], None]) -> None:
        self._stack = stack
        self._told = told
        self._held: set[int] = set()

    def look_at_all(self) -> None:
        """Look at every extension module that this process has loaded so far."""
        for module in list(sys.modules.values()):
            file = vars(module).get("__file__") if isinstance(module, ModuleType) else None
            if isinstance(file, str) and file.endswith(_SUFFIXES):
                self.look_at(file)

    def look_at(self, file: str, handle: int | None = None) -> None:
        """Hold the TBB that a library has, or is linked with, to one thread."""
        with engage(None):
            if file in _without or self._finds(file, handle):
                return
            if not is_user_file(file) or not _has_traces(file):
                _without.add(file)
                return
        self._told(os.path.basename(file), "its functions are hidden, so its threads stay many")

    def _finds(self, file: str, handle: int | None) -> bool:
        with suppress(OSError):  # a file that is gone, or that is not for opening: the linker's own
            opened = _dlopen(file, os.RTLD_NOLOAD | os.RTLD_LAZY) if handle is None else handle
            for names in _GENERATIONS:
                with suppress(OSError):
                    found = [_dlsym(opened, name) for name in names]
                    self._hold(file, *found)
                    return True
        return False

    def _hold(self, file: str, processors: int, hold: int, release: int) -> None:
        if processors in self._held:
            return
        self._held.add(processors)
        count = _asked_on_one_processor(ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(processors))
        control = _Control(1, None, 0)
        act = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
        act(hold)(ctypes.byref(control))
        self._stack.callback(act(release), ctypes.byref(control))
        if count != 1:
            said = f"it was in use before the run and divides its work as for {count} threads"
            self._told(os.path.basename(file), said)


def _asked_on_one_processor(processors: Callable[[None], int]) -> int:
    """Let TBB find out how many processors there are; return how many it knows of."""
    before = _may_use(0)
    try:
        _use(0, {min(before)})
    except OSError:  # forbidden
        return processors(None)
    try:
        return processors(None)
    finally:
        _use(0, before)


def _has_traces(file: str) -> bool:
    """Return whether a file has TBB's scheduler within it."""
    with suppress(OSError), open(file, "rb") as opened:
        if 0 < os.fstat(opened.fileno()).st_size <= _LOOKED_THROUGH_MAX:
            with mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as content:
                return any(content.find(trace) >= 0 for trace in _TRACES)
    return False


@contextmanager
def one_tbb_thread(told: Callable[[str, str], None]) -> Iterator[None]:
    """Hold every TBB that this process has, or loads in the meantime, to one thread.

    ``told`` is called for a library where that cannot be done, with its name and why.
    """
    with ExitStack() as stack:
        threads = _Threads(stack, told)
        threads.look_at_all()

        def importing(real: Callable[..., Any]) -> Callable[..., Any]:
            def create_dynamic(spec: Any, *rest: Any) -> Any:
                made = real(spec, *rest)
                threads.look_at(spec.origin)
                return made

            return create_dynamic

        def opening(real: Callable[..., int]) -> Callable[..., int]:
            def dlopen(name: Any, *rest: Any) -> int:
                handle = real(name, *rest)
                if name is not None:
                    threads.look_at(os.fsdecode(name), handle)
                return handle

            return dlopen

        redirect(stack, _imp.create_dynamic, importing)
        redirect(stack, _ctypes.dlopen, opening)
        yield


__all__ = ["one_tbb_thread"]
