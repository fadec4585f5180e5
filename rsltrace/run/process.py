"""Prepare the process for a run: module search, memory, and callbacks for progress."""

from __future__ import annotations

import ctypes
import gc
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from rsltrace.adapters.rclpy.messages.interface_classes import forget_interfaces
from rsltrace.adapters.workspace.imports import unbuilt_packages
from rsltrace.fast_dataclass import dataclass
from rsltrace.guard.callers import is_rsltrace_module
from rsltrace.guard.guard import engage
from rsltrace.job import Job
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.mcap.descriptor import PrivateDescriptor
from rsltrace.trace.model.texts import ros_release

if TYPE_CHECKING:
    from rsltrace.simulation.middleware.events.dispatcher import Dispatcher

_PROGRESS_EVERY_EVENTS = 1_000
_GC_EVERY_EVENTS = 10_000
_FIRST_GC_EVENTS = 1_000
"""What construction has left behind is looked at once, and early: it is the most there ever is."""

_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_HEAP_SPARE_BYTES = 64 << 20
_HEAP_BLOCK_BYTES = 8 << 20


@dataclass(frozen=True, slots=True)
class RunCallbacks:
    """Callbacks of the caller of a run. ``progress`` gets (simulated ns, end ns or None, events)
    about every thousand events; ``interrupt`` gets a function that ends the run properly; ``note``
    gets notes from before the run (an incomplete bag, ignored parts of a launch file).
    ``samples_states`` puts samples of nodes' states into the trace."""

    progress: Callable[[int, int | None, int], None] | None = None
    interrupt: Callable[[Callable[[Stop], None]], None] | None = None
    note: Callable[[str], None] | None = None
    samples_states: bool = False


def housekeeping(
    dispatcher: Callable[[], Dispatcher], observer: RunCallbacks, end_ns: int | None
) -> Callable[[], int]:
    """Return the function called between time steps: it reports progress and collects garbage.

    Python's collector would run finalizers in the middle of a callback; here they run between
    steps, after the same events in every run.
    """
    collect_at = _FIRST_GC_EVENTS

    def between_steps() -> int:
        nonlocal collect_at
        events = dispatcher().loop.events
        if events >= collect_at:
            collect_at = events + _GC_EVERY_EVENTS
            with dispatcher().outside_events():
                gc.collect(1)
        if observer.progress is None:
            return collect_at
        with engage(None):  # the caller's code runs in real time
            observer.progress(dispatcher().loop.stamp, end_ns, events)
        return min(collect_at, events + _PROGRESS_EVERY_EVENTS)

    return between_steps


@contextmanager
def gc_disabled() -> Iterator[None]:
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


_lives_on = True


def skip_final_collection() -> None:
    """For a command: leave existing objects out of garbage collection until the process ends.
    Python would look at them several times then, a sixth of a short command's time."""
    global _lives_on
    _lives_on = False


@contextmanager
def frozen_gc() -> Iterator[None]:
    """Exclude the objects that exist before the run from garbage collection: they take longer to
    scan than what the run makes."""
    gc.freeze()
    try:
        yield
    finally:
        if _lives_on:
            gc.unfreeze()


def keep_freed_memory() -> None:
    """Let the C library keep freed memory for reuse.

    Trace segments use blocks of half a megabyte again and again. glibc returns such blocks to the
    kernel, and new ones are cleared page by page, up to a fifth of the cost of a recorded event.
    Without mallopt(3), or with its environment variables set, nothing changes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None and not any(name.startswith("MALLOC_") for name in os.environ):
        mallopt(_M_TRIM_THRESHOLD, _HEAP_SPARE_BYTES)
        mallopt(_M_MMAP_THRESHOLD, _HEAP_BLOCK_BYTES)


_INSTALLED = frozenset(("site-packages", "dist-packages"))


@contextmanager
def preserved_process() -> Iterator[None]:
    """Restore what user code may change of the process: directory, arguments, environment.

    The caller's paths are relative to its directory. Not for a ``Simulation``, whose driver may
    change the process on purpose.
    """
    folder = ""
    with suppress(FileNotFoundError):  # it may have been removed
        folder = os.getcwd()
    argv, words, environment = sys.argv, list(sys.argv), dict(os.environ)
    mask = os.umask(0o077)
    os.umask(mask)
    try:
        with _kept_streams():
            yield
    finally:
        with suppress(FileNotFoundError):
            os.chdir(folder)
        os.umask(mask)
        sys.argv, argv[:] = argv, words
        for name in set(os.environ) - set(environment):
            del os.environ[name]
        for name, value in environment.items():
            if os.environ.get(name) != value:
                os.environ[name] = value


@contextmanager
def _kept_streams() -> Iterator[None]:
    """Restore the standard streams: nodes replace them, and daemons redirect them."""
    names = ("stdin", "stdout", "stderr")
    streams = {name: getattr(sys, name) for name in names}
    copies = {}
    for number in range(3):
        with suppress(OSError):
            copies[number] = PrivateDescriptor.copy_of(number)
    try:
        yield
    finally:
        for name, stream in streams.items():
            with suppress(Exception):
                getattr(sys, name).flush()
            setattr(sys, name, stream)
        for number, copy in copies.items():
            with suppress(OSError):
                copy.restore(number)
                copy.close()


@contextmanager
def search_path(job: Job, *, native: bool = False) -> Iterator[None]:
    """Let user modules be imported from the job's search path, with the variables of a sourced ROS,
    and unload them afterwards.

    In a ``native`` run, unbuilt interfaces cannot be sent.
    """
    folders = [str(job.resolve(folder)) for folder in job.search_path]
    old_path, old_modules = list(sys.path), set(sys.modules)
    sys.path[:0] = folders
    try:
        with _sourced(), unbuilt_packages(list(map(Path, folders)), native=native) as workspace:
            try:
                yield
            finally:
                if workspace.made:
                    forget_interfaces()
    finally:
        sys.path[:] = old_path
        COPIED_FILES.clear()
        for name in {*user_modules(folders), *_namespaces(folders)} - old_modules:
            del sys.modules[name]


@contextmanager
def _sourced() -> Iterator[None]:
    """Set the variables of ROS's setup files that are not set."""
    values = {"ROS_VERSION": "2", "ROS_PYTHON_VERSION": "3", "ROS_DISTRO": _distribution()}
    added = {name: value for name, value in values.items() if value and name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@lru_cache(maxsize=1)
def _distribution() -> str:
    """Return the ROS release of rclpy's wheel, or ""."""
    spec = importlib.util.find_spec("rclpy")
    if spec is None or spec.origin is None:
        return ""
    versions = Path(spec.origin).parents[1].glob("rclpy-*-info")
    names = (ros_release(path.name.removeprefix("rclpy-")) for path in versions)
    return next(filter(None, names), "")


def _namespaces(folders: list[str]) -> list[str]:
    """Return the loaded namespace packages in ``folders``."""
    below = _below(folders)
    return [
        name
        for name, module in sys.modules.items()
        if getattr(module, "__file__", None) is None
        and any(_is_below(os.path.join(path, ""), below) for path in _path_of(module))
    ]


def _path_of(module: object) -> list[str]:
    path = vars(module).get("__path__") if isinstance(module, ModuleType) else None
    with suppress(KeyError):  # its parent is gone
        return [one for one in path or () if isinstance(one, str)]
    return []


COPIED_FILES: dict[str, str] = {}
"""Files of modules of which mains have copies of their own, which ``sys.modules`` does not show."""


def user_modules(folders: list[str]) -> dict[str, Path]:
    """Return the files of loaded modules in ``folders``, by module name; not of installed packages
    or of rsltrace.

    An episode of a ``Simulation`` asks this repeatedly for thousands of modules, so it works on
    strings.
    """
    below = _below(folders)
    found: dict[str, Path] = {}
    for name, module in sorted(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if isinstance(file, str) and not is_rsltrace_module(name) and _is_below(file, below):
            found[name] = Path(file)
    return found


def is_below(file: str, folders: Sequence[str]) -> bool:
    """Whether a file lies in ``folders`` and is not an installed package."""
    return _is_below(file, _below(folders))


def _below(folders: Sequence[str]) -> tuple[str, ...]:
    return tuple(os.path.join(folder, "") for folder in folders)


def _is_below(file: str, below: tuple[str, ...]) -> bool:
    path = os.path.normpath(file)
    return path.startswith(below) and _INSTALLED.isdisjoint(path.split(os.sep))


def python_path() -> list[Path]:
    """Return the folders of ``PYTHONPATH``."""
    listed = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    return [Path(os.path.abspath(folder)) for folder in listed]


def run_as_main(name: str) -> ModuleSpec | None:
    """Return the spec that ``python -m name`` runs: the module, or a package's ``__main__``.

    Imports the parent packages, which may raise anything.
    """
    spec = importlib.util.find_spec(name)
    if spec is not None and spec.submodule_search_locations is not None:
        spec = importlib.util.find_spec(f"{name}.__main__")
    return spec


def is_pytest_module(name: str) -> bool:
    """Whether pytest loaded a module: a test module or a conftest."""
    spec = getattr(sys.modules.get(name), "__spec__", None)
    return type(getattr(spec, "loader", None)).__module__.startswith("_pytest.")
