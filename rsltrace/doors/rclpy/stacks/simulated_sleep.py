"""For the time of a run ``time.sleep`` is simulated, and so are the modules rclpy waits with."""

from __future__ import annotations

import sys
import threading
import time
from _thread import get_ident
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING

from rsltrace.doors.rclpy.stacks.blocking_calls import getpid, wait
from rsltrace.doors.rclpy.stacks.sim_event import SimEvent
from rsltrace.guard.recorded.processes import sleep_for_process
from rsltrace.guard.redirect import Redirected, copy_of

if TYPE_CHECKING:
    from rsltrace.doors.rclpy.core import Core

_SHUTDOWN_NS = 10_000_000_000
_SHORTEST_SLEEP_NS = 1_000_000
_real_sleep = copy_of(time.sleep)  # type: ignore[arg-type]
_world: list[Core] = []


def simulated_core() -> Core | None:
    """Return the world in which the calling code runs: a node's, not that of who drives it."""
    core = _world[-1] if _world else None
    if core is None or get_ident() != core.thread or getpid() != core.process:
        return None
    return core if core.current_handle is not None or core.importing else None


def world_exists() -> bool:
    """Return whether a run is under way, here or in the process that this one was forked from."""
    return bool(_world)


def _sleep(seconds: float) -> None:
    """Stand in for ``time.sleep`` while a run lasts."""
    core = simulated_core()
    if core is None or core.current_handle is None:
        _real_sleep(seconds)
        return
    if seconds < 0:
        raise ValueError("sleep length must be non-negative")
    frame = sys._getframe(1)
    if frame.f_globals.get("__name__") == "subprocess":
        sleep_for_process(seconds, _real_sleep, frame)
        return
    for_ns = int(seconds * 1_000_000_000)
    if core.ending and core.shutdown_ns < _SHUTDOWN_NS:
        # Time stands still, but destroy_node and ``finally`` shall have their say: as much as
        # ros2 launch leaves a node between SIGINT and SIGKILL.
        core.shutdown_ns += max(for_ns, _SHORTEST_SLEEP_NS)
        return
    wait(core, f"{seconds} s to pass", for_ns=for_ns)


@contextmanager
def simulated_waiting(core: Core) -> Iterator[None]:
    """Make the calls that block simulated ones: ``time.sleep``, and what rclpy waits with."""
    import rclpy.action.client
    import rclpy.client
    import rclpy.node
    import rclpy.task
    import rclpy.timer

    def now() -> float:
        return core.loop.now_ns / 1_000_000_000

    replaced = [
        (rclpy.node, "time", SimpleNamespace(time=now, monotonic=now, sleep=_sleep)),
        (rclpy.client, "time", SimpleNamespace(time=now, monotonic=now, sleep=_sleep)),
        (rclpy.client, "threading", _threading(core, "the response to a service call")),
        (rclpy.timer, "threading", _threading(core, "the next period of a Rate")),
        (rclpy.action.client, "threading", _threading(core, "an answer of an action server")),
        (rclpy.task, "threading", SimpleNamespace(Lock=threading.Lock)),  # never held while waiting
        (rclpy.action.client, "uuid", SimpleNamespace(uuid4=core.random_uuid)),
    ]
    saved = [(module, name, getattr(module, name)) for module, name, _ in replaced]
    for module, name, value in replaced:
        setattr(module, name, value)
    turned = Redirected(time.sleep, _sleep)  # type: ignore[arg-type]
    _world.append(core)
    try:
        yield
    finally:
        _world.remove(core)
        turned.restore()
        for module, name, value in saved:
            setattr(module, name, value)


def _threading(core: Core, what: str) -> SimpleNamespace:
    return SimpleNamespace(
        Event=partial(SimEvent, core, what), Lock=threading.Lock, RLock=threading.RLock
    )
