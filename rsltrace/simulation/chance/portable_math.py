"""Logarithm and exponential with the same bits on every machine."""

from __future__ import annotations

from math import frexp, ldexp

# C libraries differ in the last bit of ``log`` and ``exp``. These use only operations that IEEE 754
# rounds correctly, in a fixed order, and are good to about 1e-15.

_SQRT_HALF = 0.7071067811865476
_LN2_HIGH = 0.693147180369123816490
_LN2_LOW = 1.90821492927058770002e-10
_LOG2_E = 1.4426950408889634
_LOG_TERMS = tuple(1.0 / k for k in range(25, 0, -2))
_EXP_TERMS = tuple(1.0 / k for k in range(16, 0, -1))


def log(x: float) -> float:
    """Return the natural logarithm of ``x > 0``, by the series of atanh."""
    fraction, exponent = frexp(x)
    if fraction < _SQRT_HALF:
        fraction *= 2.0
        exponent -= 1
    s = (fraction - 1.0) / (fraction + 1.0)
    square = s * s
    total = 0.0
    for coefficient in _LOG_TERMS:
        total = total * square + coefficient
    return exponent * _LN2_HIGH + (2.0 * s * total + exponent * _LN2_LOW)


def exp(x: float) -> float:
    """Return e to the power of ``x`` (|x| up to 700), by range reduction and Taylor's series."""
    exponent = int(x * _LOG2_E + (0.5 if x >= 0.0 else -0.5))
    rest = (x - exponent * _LN2_HIGH) - exponent * _LN2_LOW
    total = 1.0
    for reciprocal in _EXP_TERMS:
        total = 1.0 + rest * reciprocal * total
    return ldexp(total, exponent)
