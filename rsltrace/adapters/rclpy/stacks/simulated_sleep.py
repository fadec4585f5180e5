"""For the time of a run ``time.sleep`` is simulated, and so are the modules rclpy waits with."""

from __future__ import annotations

import random
import sys
import threading
import time
import uuid
from _thread import get_ident
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

from rsltrace.adapters.rclpy.stacks.blocking_calls import getpid, wait
from rsltrace.adapters.rclpy.stacks.runners import Stacks
from rsltrace.adapters.rclpy.stacks.sim_event import SimEvent
from rsltrace.guard.libraries import present_import
from rsltrace.guard.recorded.processes import sleep_for_process
from rsltrace.guard.redirect import Redirected, copy_of
from rsltrace.simulation.middleware.events.event import Event
from rsltrace.trace.model.texts import patience_ns

_SHUTDOWN_NS = 10_000_000_000
_SHORTEST_SLEEP_NS = 1_000_000
_RATE = (
    "the next period of a Rate, which is a timer of its node: an executor has to spin the node "
    "meanwhile, in another thread"
)
_real_sleep = copy_of(time.sleep)  # type: ignore[arg-type]
_world: list[Stacks] = []


def simulated_stacks() -> Stacks | None:
    """Return the world in which the calling code runs: a node's, not that of who drives it."""
    stacks = _world[-1] if _world else None
    if stacks is None or get_ident() != stacks.runners.thread or getpid() != stacks.runners.process:
        return None
    return stacks if stacks.event.handle is not None or stacks.programs.importing else None


def world_exists() -> bool:
    """Return whether a run is under way, here or in the process that this one was forked from."""
    return bool(_world)


def _sleep(seconds: float) -> None:
    """Stand in for ``time.sleep`` while a run lasts."""
    library = present_import()
    if library is not None:
        library.passed_ns += int(seconds * 1_000_000_000)
    stacks = simulated_stacks()
    if stacks is None or stacks.event.handle is None or library is not None:
        _real_sleep(seconds)
        return
    if seconds < 0:
        raise ValueError("sleep length must be non-negative")
    frame = sys._getframe(1)
    if frame.f_globals.get("__name__") == "subprocess":
        sleep_for_process(seconds, _real_sleep, frame)
        return
    for_ns = patience_ns(seconds)
    if stacks.ending.unwinding and stacks.ending.shutdown_ns < _SHUTDOWN_NS:
        # Time stands still, but destroy_node and ``finally`` shall have their say: as much as
        # ros2 launch leaves a node between SIGINT and SIGKILL.
        stacks.ending.shutdown_ns += max(for_ns, _SHORTEST_SLEEP_NS)
        return
    wait(stacks, f"{seconds} s to pass", for_ns=for_ns)


@contextmanager
def simulated_waiting(stacks: Stacks, seed: int) -> Iterator[None]:
    """Make the calls that block simulated ones: ``time.sleep``, and what rclpy waits with."""
    import rclpy.action.client
    import rclpy.client
    import rclpy.node
    import rclpy.task
    import rclpy.timer

    def now() -> float:
        return stacks.loop.now_ns / 1_000_000_000

    replaced = [
        (rclpy.node, "time", SimpleNamespace(time=now, monotonic=now, sleep=_sleep)),
        (rclpy.client, "time", SimpleNamespace(time=now, monotonic=now, sleep=_sleep)),
        (rclpy.client, "threading", _threading(stacks, "the response to a service call")),
        (rclpy.timer, "threading", _threading(stacks, _RATE)),
        (rclpy.action.client, "threading", _threading(stacks, "an answer of an action server")),
        (rclpy.task, "threading", SimpleNamespace(Lock=threading.Lock)),  # never held while waiting
        (rclpy.action.client, "uuid", SimpleNamespace(uuid4=_goal_ids(stacks.event, seed))),
    ]
    saved = [(module, name, getattr(module, name)) for module, name, _ in replaced]
    for module, name, value in replaced:
        setattr(module, name, value)
    turned = Redirected(time.sleep, _sleep)  # type: ignore[arg-type]
    _world.append(stacks)
    try:
        yield
    finally:
        _world.remove(stacks)
        turned.restore()
        for module, name, value in saved:
            setattr(module, name, value)


def _goal_ids(event: Event, seed: int) -> Callable[[], uuid.UUID]:
    """Return what makes random UUIDs from a stream of the present node: goals need ids."""
    streams: dict[str, random.Random] = {}

    def uuid4() -> uuid.UUID:
        name = event.node.fully_qualified_name if event.node is not None else ""
        stream = streams.setdefault(name, random.Random(f"goal ids {seed} {name}"))
        return uuid.UUID(int=stream.getrandbits(128), version=4)

    return uuid4


def _threading(stacks: Stacks, what: str) -> SimpleNamespace:
    return SimpleNamespace(
        Event=partial(SimEvent, stacks, what), Lock=threading.Lock, RLock=threading.RLock
    )
