"""A port for a server that cannot be given 0."""

from __future__ import annotations

import random
import socket
from pathlib import Path


def free_port() -> int:
    """Return a TCP port of this machine that is free. The kernel gives it to nobody who asks for
    any, so it is still free when the server comes."""
    words = Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()
    while True:
        port = random.SystemRandom().randrange(10_000, int(words[0]))
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
