"""Simulated time is an integer number of nanoseconds; this module only reads and prints it."""

from __future__ import annotations

NS_PER_S = 1_000_000_000
_IN_FULL_NS = 1_000_000 * NS_PER_S


def format_seconds(stamp_ns: int) -> str:
    """Return ``stamp_ns`` as seconds, exactly, with nine decimals: ``1.500000000``."""
    sign = "-" if stamp_ns < 0 else ""
    whole, fraction = divmod(abs(stamp_ns), NS_PER_S)
    return f"{sign}{whole}.{fraction:09d}"


def patience_ns(seconds: float) -> int:
    """Return how long to wait for ``seconds``: a nanosecond at least, if it is more than nothing.

    Who waits for what is left until a time (``Semaphore.acquire``, ``Condition.wait_for``) may find
    that 1e-17 s are left: it would ask for ever, and never would any time pass.
    """
    return int(seconds * NS_PER_S) or int(seconds > 0)


def format_duration(duration_ns: int) -> str:
    """Return a duration for people: ``12.5 s``, ``3.2 ms``, ``250 ns``.

    A million seconds and more are told in full: they are times since 1970.
    """
    size = abs(duration_ns)
    if size >= _IN_FULL_NS:
        return f"{format_seconds(duration_ns).rstrip('0').rstrip('.')} s"
    for unit, scale in (("s", NS_PER_S), ("ms", 1_000_000), ("us", 1_000)):
        if size >= scale:
            return f"{duration_ns / scale:.6g} {unit}"
    return f"{duration_ns} ns"
