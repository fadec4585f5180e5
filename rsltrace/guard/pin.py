"""Pin the process: set what must be set before Python starts, and what libraries read once.

``pin`` starts the same command again in this process: with a fixed hash seed, without address-space
randomization (where the kernel allows it), in UTC and C.UTF-8, without Python's own options, with
one thread per numerical library and sorted library folders. It costs one start of Python.
``unpin`` goes back.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

_MARK = "RSLTRACE_PINNED"
"""The environment variable with the settings before the pinned start."""

HASH_SEED = "PYTHONHASHSEED"
PLACE = {"TZ": "UTC", "LC_ALL": "C.UTF-8"}
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
    "RAYON_NUM_THREADS",  # libraries written in Rust
)
PYTHON_OPTIONS = (
    "PYTHONOPTIMIZE",  # no assert, no docstrings
    "PYTHONWARNINGS",  # warnings that raise
    "PYTHONINTMAXSTRDIGITS",
    "PYTHONDEVMODE",
    "PYTHONASYNCIODEBUG",
    "PYTHONNODEBUGRANGES",  # no marks in tracebacks
    "PYTHONUTF8",
    "PYTHONIOENCODING",
)
"""Variables that change what Python programs do; a pinned process has none of them."""
PINNED_VARIABLES = {HASH_SEED: "0", **PLACE, **dict.fromkeys(THREAD_VARIABLES, "1")}

MEMORY_NOISE = "RSLTRACE_MEMORY_NOISE"
"""How ``verify`` perturbs the memory of compiled processes, which ``record`` keeps the same: a seed
for allocations before the program's own, and 1 for random addresses (``123:1``)."""

_LIBRARIES = "LD_LIBRARY_PATH"
_BY_WHEELS = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
"""ROS's wheels set this once they have started Python again with their folders."""

_DUPLICATES = "KMP_DUPLICATE_LIB_OK"

_ADDR_NO_RANDOMIZE = 0x0040000
_ASK = 0xFFFFFFFF
_UNPINNED = "off"
_RUNS_NODES = frozenset(("record", "replay", "debug", "analyze"))
_NOTHING_TO_PIN = frozenset(("--no-pin", "--help", "-h"))

_before = ""
"""The settings before this process was pinned, as Python writes them."""


def pin_recording(words: Sequence[str]) -> None:
    """Pin the process if a command line (without the program's name) runs nodes."""
    if _RUNS_NODES.intersection(words[:1]) and not _NOTHING_TO_PIN.intersection(words):
        pin()


def pin() -> None:
    """Start this command again, pinned; return if it is pinned already or cannot be."""
    global _before
    _before = os.environ.pop(_MARK, _before)  # programs that a node starts are none of ours
    if _before or not sys.orig_argv[1:]:
        return
    changes = {**pinned_variables(), **dict.fromkeys(PYTHON_OPTIONS)}
    before = {name: os.environ.get(name) for name in changes}
    fixed = fix_addresses(True)
    _start_again({**changes, _MARK: repr({**before, "addresses": fixed})})


def pinned_variables() -> dict[str, str]:
    """Return the environment variables of a pinned process and of the processes of a run."""
    return {**PINNED_VARIABLES, **_libraries()}


def _libraries() -> dict[str, str]:
    """Return the library folders, sorted.

    ROS's wheels list their folders in the order of a set, which differs at each start. Several hold
    copies of one library: which one is loaded, and where, would differ from run to run.
    """
    folders = os.environ.get(_LIBRARIES, "")
    if _BY_WHEELS not in os.environ or not folders:
        return {}
    return {_LIBRARIES: os.pathsep.join(sorted(folders.split(os.pathsep)))}


def unpin() -> None:
    """Start this command again as it was before ``pin``; return if it was not pinned."""
    if _before in ("", _UNPINNED):
        return
    import ast

    before = ast.literal_eval(_before)
    if before.pop("addresses", False):
        fix_addresses(False)
    _start_again({**before, _MARK: _UNPINNED})


def _start_again(changes: Mapping[str, str | None]) -> None:
    environment = {**os.environ, **changes}
    kept = {name: value for name, value in environment.items() if value is not None}
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # closed by the parent process
            stream.flush()
    try:
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], kept)
    except OSError:
        return  # go on unpinned; the trace's environment says so


def fix_addresses(fixed: bool) -> bool:
    """Give programs started from here fixed or random addresses; return whether that changed."""
    now = _personality(_ASK)
    if now < 0 or bool(now & _ADDR_NO_RANDOMIZE) is fixed:
        return False
    wanted = now | _ADDR_NO_RANDOMIZE if fixed else now & ~_ADDR_NO_RANDOMIZE
    return _personality(wanted) >= 0 and _personality(_ASK) == wanted


def has_fixed_addresses() -> bool:
    """Return whether this process has the fixed addresses of a pinned process."""
    now = _personality(_ASK)
    return now >= 0 and bool(now & _ADDR_NO_RANDOMIZE)


def _personality(value: int) -> int:
    """Call ``personality``; -1 where the system has none or forbids it."""
    import ctypes  # here: few commands need it

    try:
        return int(ctypes.CDLL(None).personality(ctypes.c_ulong(value)))
    except (OSError, AttributeError):
        return -1


def import_threadpoolctl() -> ModuleType:
    """Return threadpoolctl, without the OpenMP variable that its import sets.

    Processes of the first run would otherwise have one variable more than those of the next.
    """
    before = os.environ.get(_DUPLICATES)
    found = import_module("threadpoolctl")
    if before is None:
        os.environ.pop(_DUPLICATES, None)
    return found


@contextmanager
def kept_variables(names: Iterable[str]) -> Iterator[None]:
    """Restore variables of the environment after the block."""
    before = {name: os.environ.get(name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def pinned_place() -> Iterator[None]:
    """Pin time zone, locale and numerical threads from within the process."""
    before = {name: os.environ.get(name) for name in PLACE}
    if before == PLACE and all(os.environ.get(name) == "1" for name in THREAD_VARIABLES):
        yield
        return
    with import_threadpoolctl().threadpool_limits(limits=1):
        try:
            with kept_variables(PLACE):
                os.environ.update(PLACE)
                time.tzset()
                yield
        finally:
            time.tzset()
