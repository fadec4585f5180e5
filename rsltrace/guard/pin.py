"""Pinning the process: what can only be set before Python starts, and what libraries read once.

``pin`` starts the same command once more in the same process, with a fixed hash seed, without
address-space randomisation (where the kernel allows it), in UTC, in the C.UTF-8 locale, and with
one thread for each numerical library. It costs what starting Python costs. ``unpin`` goes back.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager

MARK = "RSLTRACE_PINNED"
"""Environment variable that says that it is done; it holds what was there before."""

HASH_SEED = "PYTHONHASHSEED"
PLACE = {"TZ": "UTC", "LC_ALL": "C.UTF-8"}
THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
PINNED = {HASH_SEED: "0", **PLACE, **dict.fromkeys(THREADS, "1")}

_ADDR_NO_RANDOMIZE = 0x0040000
_ASK = 0xFFFFFFFF


def pin() -> None:
    """Start the present command again, pinned; return if it is, or if that is not possible."""
    if MARK in os.environ or not sys.orig_argv[1:]:
        return
    before = {name: os.environ.get(name) for name in PINNED}
    fixed = fix_addresses(True)
    _start_again({**PINNED, MARK: json.dumps({**before, "addresses": fixed})})


def unpin() -> None:
    """Start the present command again as it was before ``pin``; return if it was not pinned."""
    text = os.environ.get(MARK, "")
    if not text.startswith("{"):
        return
    before = json.loads(text)
    if before.pop("addresses", False):
        fix_addresses(False)
    _start_again({**before, MARK: "off"})


def _start_again(changes: Mapping[str, str | None]) -> None:
    environment = {**os.environ, **changes}
    kept = {name: value for name, value in environment.items() if value is not None}
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # closed by whoever started us
            stream.flush()
    try:
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], kept)
    except OSError:
        return  # go on unpinned; the trace's environment says so


def fix_addresses(fixed: bool) -> bool:
    """Let programs started from here have fixed addresses, or random ones; whether that changed."""
    try:
        personality = ctypes.CDLL(None, use_errno=True).personality
    except (OSError, AttributeError):
        return False
    now = personality(_ASK)
    if now < 0 or bool(now & _ADDR_NO_RANDOMIZE) is fixed:
        return False
    wanted = now | _ADDR_NO_RANDOMIZE if fixed else now & ~_ADDR_NO_RANDOMIZE
    return bool(personality(wanted) >= 0 and personality(_ASK) == wanted)


def pinned_values() -> dict[str, str]:
    """Return what is pinned in this process, for the trace's environment."""
    seed = os.environ.get(HASH_SEED, "random")
    try:
        now = ctypes.CDLL(None).personality(_ASK)
    except (OSError, AttributeError):
        now = 0
    return {
        "hash_seed": seed,
        "addresses": "fixed" if now >= 0 and now & _ADDR_NO_RANDOMIZE else "random",
    }


def numerics() -> str:
    """Return which numerical libraries are loaded, with the kernel they chose for this machine."""
    import numpy  # noqa: F401 - loads its library
    from threadpoolctl import threadpool_info

    found = {
        " ".join(
            str(pool.get(key))
            for key in ("internal_api", "version", "architecture")
            if pool.get(key)
        )
        for pool in threadpool_info()
    }
    return ", ".join(sorted(found)) or "unknown"


@contextmanager
def pinned_place() -> Iterator[None]:
    """Pin what can be pinned from within: time zone, locale and numerical threads."""
    from threadpoolctl import threadpool_limits

    before = {name: os.environ.get(name) for name in PLACE}
    if before == PLACE and all(os.environ.get(name) == "1" for name in THREADS):
        yield
        return
    with ExitStack() as stack:
        stack.enter_context(threadpool_limits(limits=1))
        os.environ.update(PLACE)
        time.tzset()
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value
            time.tzset()
