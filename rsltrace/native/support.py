"""What of a job a native run does, what it leaves out, and what it cannot do without."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rsltrace.errors import JobError, SetupError
from rsltrace.guard.pin import kept_variables
from rsltrace.job import Job, locate
from rsltrace.simulation.loop.policy import PriorityRule

# A DDS domain of one's own on this machine, so that nobody else's nodes take part.

DOMAIN_MAX = 101
"""The largest whose ports lie below those that Linux gives to anybody (RTPS 2.2, 9.6.1.1)."""

_SIOCGIFFLAGS, _IFF_UP = 0x8913, 1  # netdevice(7)


@contextmanager
def domain(given: int | None) -> Iterator[int]:
    """Take part in the given domain as the environment says, or alone in a free one.

    A free one is this machine's only: no message leaves it.

    :raises SetupError: if all domains are taken.
    """
    names = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY")
    with kept_variables(names), _free(given) as number:
        os.environ["ROS_DOMAIN_ID"] = str(number)
        if given is None:
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
            os.environ.pop("ROS_LOCALHOST_ONLY", None)
        yield number


@contextmanager
def _free(given: int | None) -> Iterator[int]:
    if given is not None:
        yield given
        return
    for number in random.SystemRandom().sample(range(1, DOMAIN_MAX + 1), DOMAIN_MAX):
        # Another recording may be looking, too: a name in the kernel is only one's.
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                claim.bind(f"\0rsltrace native domain {number}")
            except OSError:
                continue
            if _is_quiet(number):
                yield number
                return
    raise SetupError(
        f"all DDS domains from 1 to {DOMAIN_MAX} are in use on this machine; choose one (--domain)"
    )


def check_loopback() -> None:
    """Raise ``SetupError`` if processes of this machine cannot reach each other.

    The middleware would say nothing, and no node would find another.
    """
    request = struct.pack("16sH22x", b"lo", 0)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
            answer = fcntl.ioctl(any_socket, _SIOCGIFFLAGS, request)
    except OSError:
        return  # nobody can tell
    flags = struct.unpack_from("H", answer, 16)[0]
    if not flags & _IFF_UP:
        raise SetupError(
            "the loopback network is down, so that processes cannot find each other: ip link set "
            "lo up"
        )


def _is_quiet(number: int) -> bool:
    """Whether nobody on this machine listens where the first participant of a domain would."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", 7400 + 250 * number + 10))
        except OSError:
            return False
    return True


_PART_S = 0.05


class Patience:
    """So many seconds for several waits, but for those in which the whole machine stands still.

    They are counted in short parts: of one that a suspended or stalled machine makes long, whoever
    is waited for has had nothing either.
    """

    def __init__(self, seconds: float) -> None:
        self._left = round(seconds / _PART_S)

    def wait(self, wait: Callable[[float], object], is_met: Callable[[], bool]) -> bool:
        """Wait with ``wait(seconds)`` until something is met; return whether it is."""
        while not is_met():
            if self._left <= 0:
                return False
            self._left -= 1
            wait(_PART_S)
        return True

    def wait_for_end(self, thread: threading.Thread) -> bool:
        """Wait for a thread; return whether it has ended."""
        return self.wait(thread.join, lambda: not thread.is_alive())


# Putting a wrapper around a function for a while.


@contextmanager
def patched(
    owner: Any, name: str, wrap: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> Iterator[None]:
    """Have ``owner.name`` be ``wrap`` of itself within the ``with`` block."""
    original = getattr(owner, name)
    setattr(owner, name, wrap(original))
    try:
        yield
    finally:
        setattr(owner, name, original)


_STEERING = (
    "start_ns",
    "construct_time_ns",
    "seed",
    "timer_ties",
    "livelock_limit",
    "guard",
    "delay",
    "policy",
    "min_time_step_ns",
    "executors",
    "execution",
    "clocks",
    "faults",
    "threads",
    "parallel",
    "vary",
)
"""Keys of a job that say how a simulation goes; nobody can tell real time and DDS."""


def check(job: Job) -> None:
    """Raise ``JobError`` at the first part of a job that has to be and cannot be native."""
    for index, spec in enumerate(job.nodes):
        if spec.stdin is not None:
            raise JobError(
                "a native run types nothing: leave stdin out, or give arguments",
                where=spec.origin or locate(job, ("nodes", index, "stdin")),
            )
    for name in ("before", "after"):
        if getattr(job.hooks, name) is not None:
            raise JobError("a native run has no hooks", where=locate(job, ("hooks", name)))
    if not job.nodes and not job.bags:
        raise JobError("there are no nodes to run natively", where=locate(job, ("nodes",)))


def needs_processes(job: Job) -> bool:
    """Return whether a job has more than nodes to construct: what is a program is a process."""
    return bool(job.bags) or any(
        spec.node is None or spec.start_after is not None for spec in job.nodes
    )


def priority_rules(job: Job, policy: str | None) -> tuple[PriorityRule, ...] | None:
    """Return the rules that a native run's priorities go by, None if they go by rate.

    :raises JobError: the job has none, and ``policy`` is ``priority``.
    """
    if policy != "priority":
        return None
    rules = None if job.policy is None else job.policy.priority
    if rules is None:
        raise JobError(
            "--policy priority takes the rules of the job, which has none: write for example "
            "policy: {priority: [{node: /controller, priority: 10}]}",
            where=locate(job, ("policy",)),
        )
    return tuple(PriorityRule(r.priority, r.node, r.entity, r.group_of) for r in rules)


def ignored(job: Job, policy: str | None = None) -> list[str]:
    """Return the keys of a job that have no effect natively, where priorities go by ``policy``."""
    keys = [key.removesuffix("_ns") for key in _STEERING if key in job.given_fields]
    if "policy" in keys and job.policy is not None and policy is not None:
        given = job.policy.order or ("priority" if job.policy.priority is not None else "")
        keys = [key for key in keys if key != "policy" or policy != given]
    if any(spec.guard is not None for spec in job.nodes) and "guard" not in keys:
        keys.append("guard")
    return keys
