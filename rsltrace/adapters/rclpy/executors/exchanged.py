"""Functions of rclpy that user code exchanges: one is called, of the others the run tells.

Monitoring libraries put code of their own around the functions by which rclpy's executors run
callbacks. The loop does without these. ``await_or_execute``, through which all callbacks go, is
called nevertheless once somebody has replaced it; what else is replaced must not be lost in
silence.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import PurePath
from types import ModuleType
from typing import Any

from rsltrace.adapters.rclpy.stacks.stacks import Stacks
from rsltrace.simulation.middleware.source_position import file_of
from rsltrace.trace.model.never_called import EXECUTOR, NEVER_CALLED

_THROUGH = "await_or_execute"
_ASKED_BY_SPINS = "wait_for_ready_callbacks"
_OWN = (
    ("rclpy", "executors.py"),
    ("rclpy", "callback_groups.py"),
    ("executors", "user_executors.py"),
)


@contextmanager
def exchanged_function_called(stacks: Stacks) -> Iterator[None]:
    """Run callbacks through what user code puts in place of ``await_or_execute``, if it does."""
    from rclpy import executors

    def look() -> None:
        through = getattr(executors, _THROUGH)
        stacks.runs_callbacks = None if _is_own(through) else through
        for node in stacks.domain.graph.nodes:
            wrapper = getattr(node, "wrapper", None)
            for one in [*wrapper.subscriptions, *wrapper.timers] if wrapper is not None else ():
                one.handle.forget_callback()

    class Watched(ModuleType):
        def __setattr__(self, name: str, value: object) -> None:
            super().__setattr__(name, value)
            if name == _THROUGH:
                look()

    kind = type(executors)
    executors.__class__ = Watched
    look()
    try:
        yield
    finally:
        executors.__class__ = kind


def note_exchanged(stacks: Stacks, executor: type | None = None, *, hosted: bool = False) -> None:
    """Tell which functions user code has replaced although nobody calls them.

    ``executor`` is a class whose bases are looked at, too. ``hosted`` says that the run itself has
    nodes to spin.
    """
    notes = stacks.domain.outcome.notes
    found = [
        f"{_where(function)}: {kind.__qualname__}.{name} is never called, because rsltrace runs "
        "callbacks itself: what it does is missing from the run (exchange "
        "rclpy.executors.await_or_execute instead, or wrap the callbacks)"
        for kind, names in _looked_at(executor)
        for name in names
        if not _is_own(function := vars(kind).get(name))
    ]
    if hosted and not _is_own(spin := vars(_named(EXECUTOR))[_ASKED_BY_SPINS]):
        found.append(
            f"{_where(spin)}: Executor.{_ASKED_BY_SPINS} is not called for nodes that the job "
            "constructs (node:), because nobody spins them: it is for those of a main: that spins"
        )
    notes += [note for note in dict.fromkeys(found) if note not in notes]


def _looked_at(executor: type | None) -> Iterator[tuple[type, tuple[str, ...]]]:
    for place, names in NEVER_CALLED.items():
        yield _named(place), names
    for kind in executor.__mro__ if executor is not None else ():
        if kind.__module__ != EXECUTOR.rpartition(".")[0]:
            yield kind, NEVER_CALLED[EXECUTOR]


def _named(place: str) -> Any:
    module, _, name = place.rpartition(".")
    return getattr(import_module(module), name)


def _is_own(function: Any) -> bool:
    """Say whether a function, if there is one, is rclpy's or what stands in for it here:
    ``functools.wraps`` copies names, but not code."""
    code = getattr(function, "__code__", None)
    parts = PurePath(code.co_filename).parts[-2:] if code is not None else ()
    return function is None or parts in _OWN


def _where(function: Any) -> str:
    code = getattr(function, "__code__", None)
    if code is None:
        return f"a {type(function).__qualname__}"
    return f"{file_of(code, function.__globals__)}:{code.co_firstlineno}"


__all__ = ["exchanged_function_called", "note_exchanged"]
