"""Libraries that need support in a run: PyTorch, pytest, pygame and TBB."""

from __future__ import annotations

import _ctypes
import _imp
import ast
import ctypes
import mmap
import operator
import os
import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.machinery import EXTENSION_SUFFIXES
from types import ModuleType
from typing import Any, NamedTuple

from rsltrace.guard.addresses import hash_method
from rsltrace.guard.callers import is_user_file
from rsltrace.guard.frames import caller, replace_member
from rsltrace.guard.guard import Guard, engage, engaged
from rsltrace.guard.redirect import copy_of, redirect, replace_attribute
from rsltrace.guard.rules import C_FUNCTIONS
from rsltrace.guard.virtual.arrays import filled
from rsltrace.guard.virtual.clocks import clock_call, numpy_now
from rsltrace.guard.virtual.set_order import in_set_order
from rsltrace.guard.virtual.user_modules import rewrite

# PyTorch draws in C++ from one generator and offers no hook. So the generator's state is switched
# whenever another node's code runs: some 10 microseconds each, only in jobs that have loaded torch.


class TorchStreams:
    """The states of torch's generator, by the name of the node (or entry point) that draws."""

    def __init__(self, generator: Any, seed: int) -> None:
        self._generator = generator
        self._seed = seed
        self._states: dict[str, Any] = {}
        self._name: str | None = None

    def enter(self, name: str) -> None:
        """Switch to a node's state."""
        if name == self._name:
            return
        self._keep()
        self._name = name
        state = self._states.get(name)
        if state is not None:
            self._generator.set_state(state)
        else:
            self._generator.manual_seed(random.Random(f"torch {self._seed} {name}").getrandbits(63))

    def rename(self, name: str) -> None:
        """Continue under another name: an entry point made its node, and may have seeded before."""
        self._keep()
        self._name = name

    def _keep(self) -> None:
        if self._name is not None:
            self._states[self._name] = self._generator.get_state()


def _seeding(real: Any) -> Any:
    def seed(self: Any) -> int:
        """Replace ``Generator.seed``, which takes entropy in C++."""
        value = int.from_bytes(os.urandom(8), "big") >> 1
        self.manual_seed(value)
        return value

    return seed


def torch_streams(stack: ExitStack, guard: Guard) -> TorchStreams:
    """Divide the generator of torch, which is loaded, among the nodes until ``stack`` ends."""
    torch: Any = sys.modules["torch"]
    generator = torch.default_generator
    stack.callback(generator.set_state, generator.get_state())
    replace_member(stack, torch._C.Generator, "seed", _seeding)
    return TorchStreams(generator, guard.streams.seed)


# ``torch.compile`` reads the running code, and would follow the guard's calls and fail at sets of
# strings. In a graph, sets are in Python's order, which is the same in all pinned processes.

TORCH_COMPILER = "torch._dynamo"
"""The module of torch that reads code."""


def _as_it_is(obj: Any) -> Any:
    return obj


def _hash_method(owner: Any) -> Any:
    return owner.__hash__


def _call(function: Any, text: str, *more: Any) -> Any:
    return function(text, *more)


def _call_with(function: Any, /, *arguments: Any, **options: Any) -> Any:
    return function(*arguments, **options)


_PLAIN_FUNCTIONS = {
    in_set_order: _as_it_is,
    hash_method: _hash_method,
    numpy_now: _call,
    filled: _call_with,
}
_known: list[object] = []


def plain_in_graphs() -> None:
    """Let torch's compiler, which is loaded, see plain Python where modules call the guard."""
    substitute = getattr(sys.modules[TORCH_COMPILER], "substitute_in_graph", None)
    if substitute is None or substitute in _known:
        return  # another version of torch, or done already
    _known.append(substitute)
    for function, meant in _PLAIN_FUNCTIONS.items():
        substitute(function)(meant)


# pytest compiles test modules itself, with an import hook before all others and a cache. During a
# run that cache is neither read nor written, so that plain pytest does not find the guard's calls
# in it.

PYTEST_REWRITER = "_pytest.assertion.rewrite"
"""The module of pytest that compiles test modules."""


def rewrite_in_pytest(stack: ExitStack) -> None:
    """Put the guard's calls into what pytest compiles from now on, until ``stack`` ends."""
    module: Any = sys.modules[PYTEST_REWRITER]
    names = ("rewrite_asserts", "_read_pyc", "_write_pyc")
    if not all(hasattr(module, name) for name in names):
        return  # another version of pytest
    real = module.rewrite_asserts

    def rewrite_asserts(tree: ast.Module, source: bytes, path: Any = None, *more: Any) -> None:
        real(tree, source, path, *more)
        if path is None or is_user_file(str(path)):
            rewrite(tree)

    instead = (rewrite_asserts, lambda *what: None, lambda *what: False)
    for name, function in zip(names, instead, strict=True):
        stack.callback(setattr, module, name, getattr(module, name))
        setattr(module, name, function)


# pygame asks SDL in C for its clock and waits; here both use simulated time.

_FRAMES = 10
"""pygame counts the frames per second anew after this many frames."""


def _ticks_of(real: Callable[[], int]) -> Callable[[], int]:
    def get_ticks() -> int:
        """Return the milliseconds since the run began."""
        guard = engaged()
        if guard is None:
            return real()
        call = "pygame.time.get_ticks()"
        found: int = clock_call(guard, caller(), call, lambda ns: ns // 1_000_000, real)
        return found

    return get_ticks


def _wait_of(real: Callable[[int], int]) -> Callable[[int], int]:
    def wait(milliseconds: int) -> int:
        """Wait in simulated time; return the milliseconds that passed."""
        if engaged() is None:
            return real(milliseconds)
        for_ms = max(operator.index(milliseconds), 0)
        time.sleep(for_ms / 1000)
        return for_ms

    return wait


def _clock_type(ticks: Callable[[], int]) -> type:
    class Clock:
        """Times the frames of a game, as ``pygame.time.Clock`` does."""

        def __init__(self) -> None:
            self._last_ms = ticks()
            self._passed_ms = self._raw_ms = 0
            self._frames, self._since_ms, self._fps = 0, 0, 0.0

        def tick(self, framerate: float = 0) -> int:
            """Wait until it is time for the next frame; return the ms since the last one."""
            self._raw_ms = ticks() - self._last_ms
            if framerate:
                time.sleep(max(int(1000 / framerate) - self._raw_ms, 0) / 1000)
            now_ms = ticks()
            self._passed_ms, self._last_ms = now_ms - self._last_ms, now_ms
            if not framerate:
                self._raw_ms = self._passed_ms
            self._frames += 1
            if not self._since_ms:
                self._frames, self._since_ms = 0, now_ms
            elif self._frames >= _FRAMES and now_ms > self._since_ms:
                self._fps = self._frames * 1000 / (now_ms - self._since_ms)
                self._frames, self._since_ms = 0, now_ms
            return self._passed_ms

        tick_busy_loop = tick

        def get_time(self) -> int:
            """Return the ms between the last two frames."""
            return self._passed_ms

        def get_rawtime(self) -> int:
            """Return the ms that the last frame took without waiting."""
            return self._raw_ms

        def get_fps(self) -> float:
            """Return how many frames there are in a second."""
            return self._fps

    return Clock


def pygame_clock(stack: ExitStack) -> None:
    """Put pygame, which is loaded, on simulated time until ``stack`` ends."""
    pygame: Any = sys.modules["pygame"]
    ticks = _ticks_of(pygame.time.get_ticks)
    replace_attribute(stack, pygame.time, "get_ticks", ticks)
    for name in ("wait", "delay"):
        replace_attribute(stack, pygame.time, name, _wait_of(getattr(pygame.time, name)))
    clock = _clock_type(ticks)
    for owner in (pygame.time, pygame):
        if hasattr(owner, "Clock"):  # pygame-ce has it in both
            replace_attribute(stack, owner, "Clock", clock)


# Intel's TBB, in ``libtbb`` and linked into extension modules, gets one thread.
#
# TBB has no environment variable. When first used, it asks how many processors the calling thread
# may use, and divides loops by that number even with a single thread: sums of floating-point
# numbers would differ between machines. So each copy of TBB asks while this thread may use one
# processor, and stays limited to one thread until the run ends.


class _TbbFunctions(NamedTuple):
    """Functions of a generation of TBB, as the linker knows them."""

    processors: str
    hold: str
    release: str


_GENERATIONS = (
    _TbbFunctions(  # oneTBB, from 2021 on
        "_ZN3tbb6detail2r115max_concurrencyEPKNS0_2d115task_arena_baseE",
        "_ZN3tbb6detail2r16createERNS0_2d114global_controlE",
        "_ZN3tbb6detail2r17destroyERNS0_2d114global_controlE",
    ),
    _TbbFunctions(
        "_ZN3tbb19task_scheduler_init19default_num_threadsEv",
        "_ZN3tbb10interface914global_control15internal_createEv",
        "_ZN3tbb10interface914global_control16internal_destroyEv",
    ),
)
_TRACES = (b"N3tbb6detail2r1", b"N3tbb8internal")
"""Names of types of TBB's scheduler; they remain where its functions are hidden."""
_LOOKED_THROUGH_MAX = 64 << 20
_SUFFIXES = tuple(EXTENSION_SUFFIXES)

_dlopen: Callable[..., int] = copy_of(_ctypes.dlopen)
_dlsym: Callable[..., int] = copy_of(_ctypes.dlsym)
_HAS_AFFINITY = hasattr(os, "sched_setaffinity")
if _HAS_AFFINITY:
    _may_use = copy_of(os.sched_getaffinity)
    _use = copy_of(os.sched_setaffinity)

_without: set[str] = set()
"""Files of this process that are known to have no TBB."""


class _TbbControl(ctypes.Structure):
    """TBB's ``global_control``: ``kind`` 0 limits the number of threads."""

    _fields_ = (("value", ctypes.c_size_t), ("next", ctypes.c_void_p), ("kind", ctypes.c_int))


class _TbbThreads:
    """The copies of TBB found in a run. ``report`` takes a library and what is wrong."""

    def __init__(self, stack: ExitStack, report: Callable[[str, str], None]) -> None:
        self._stack = stack
        self._report = report
        self._held: set[int] = set()

    def look_at_all(self) -> None:
        """Limit every extension module that this process has loaded."""
        for module in list(sys.modules.values()):
            file = vars(module).get("__file__") if isinstance(module, ModuleType) else None
            if isinstance(file, str) and file.endswith(_SUFFIXES):
                self.look_at(file)

    def look_at(self, file: str, handle: int | None = None) -> None:
        """Limit the TBB that a library contains, or is linked with, to one thread."""
        with engage(None):
            if file in _without or self._finds(file, handle):
                return
            if not is_user_file(file) or not _has_traces(file):
                _without.add(file)
                return
        self._report(os.path.basename(file), "its functions are hidden, so its threads stay many")

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
        control = _TbbControl(1, None, 0)
        act = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
        act(hold)(ctypes.byref(control))
        self._stack.callback(act(release), ctypes.byref(control))
        if count != 1:
            said = f"it was in use before the run and divides its work as for {count} threads"
            self._report(os.path.basename(file), said)


def _asked_on_one_processor(processors: Callable[[None], int]) -> int:
    """Let TBB ask for the number of processors; return the number it knows."""
    if not _HAS_AFFINITY:
        return processors(None)
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
    """Return whether a file contains TBB's scheduler."""
    with suppress(OSError), open(file, "rb") as opened:
        if 0 < os.fstat(opened.fileno()).st_size <= _LOOKED_THROUGH_MAX:
            with mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as content:
                return any(content.find(trace) >= 0 for trace in _TRACES)
    return False


@contextmanager
def one_tbb_thread(report: Callable[[str, str], None]) -> Iterator[None]:
    """Limit every TBB that this process has, or loads meanwhile, to one thread.

    ``report`` is called for a library where that fails, with its name and the reason.
    """
    with ExitStack() as stack:
        threads = _TbbThreads(stack, report)
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


# Functions of the C library that nodes load through cffi, reported like those through ctypes.


CFFI_LOADER = "cffi.api"
"""The module of cffi that opens libraries (``ffi.dlopen``)."""


class _Library:
    """A library of cffi that reports the functions taken from it."""

    def __init__(self, real: Any) -> None:
        self._real = real

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def load_function(self, kind: Any, name: str) -> Any:
        """Return a function; cffi keeps it and calls this once."""
        guard = engaged()
        source = C_FUNCTIONS.get(name)
        if guard is not None and source is not None:
            guard.report_user_call(source, f"C library: {name}()", "", caller())
        return self._real.load_function(kind, name)


def report_cffi_functions(stack: ExitStack) -> None:
    """Report functions of libraries that nodes open from now on, until ``stack`` ends."""
    module = sys.modules[CFFI_LOADER]
    real = getattr(module, "_load_backend_lib", None)
    if real is not None:
        replace_attribute(stack, module, "_load_backend_lib", lambda *given: _Library(real(*given)))
