"""A DDS domain of one's own on this machine, so that nobody else's nodes take part."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager

from rsltrace.errors import SetupError
from rsltrace.guard.pin import kept_variables

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
