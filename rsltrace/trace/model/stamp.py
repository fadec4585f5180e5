"""Simulated time is an integer number of nanoseconds; this module only reads and prints it."""

from __future__ import annotations

NS_PER_S = 1_000_000_000
_IN_FULL_NS = 1_000_000 * NS_PER_S
_DIGITS = 6
_DIGITS_MAX = 17


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


def format_duration(duration_ns: int, digits: int = _DIGITS) -> str:
    """Return a duration for people: ``12.5 s``, ``3.2 ms``, ``250 ns``, rounded to some digits.

    A million seconds and more are told in full: they are times since 1970.
    """
    size = abs(duration_ns)
    if size >= _IN_FULL_NS:
        return f"{format_seconds(duration_ns).rstrip('0').rstrip('.')} s"
    for unit, scale in (("s", NS_PER_S), ("ms", 1_000_000), ("us", 1_000)):
        if size >= scale:
            return f"{duration_ns / scale:.{digits}g} {unit}"
    return f"{duration_ns} ns"


def durations_apart(a_ns: int, b_ns: int) -> tuple[str, str]:
    """Return two durations for people, with as many digits as it takes to tell them apart."""
    for digits in range(_DIGITS, _DIGITS_MAX):
        a, b = format_duration(a_ns, digits), format_duration(b_ns, digits)
        if _told_ns(a) != _told_ns(b) or a_ns == b_ns:
            break
    return a, b


def _told_ns(text: str) -> float:
    number, unit = text.split()
    return float(number) * {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1}[unit]
