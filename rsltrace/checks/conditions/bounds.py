"""How much an expression may compute: numbers, texts, sequences and steps have an end.

The bounds count what is computed, never time: an expression is too much on every machine, or on
none.
"""

from __future__ import annotations

from typing import Any

TEXT_MAX = 4096
"""Characters of an expression."""
DEPTH_MAX = 60
"""So deeply may its parts be nested."""
INT_BITS_MAX = 512
SIZE_MAX = 1_000_000
"""Items of a sequence, or characters of a text, that an expression makes."""
STEPS_MAX = 5_000_000
"""So many steps an expression has in all its evaluations, ..."""
STEPS_EACH = 2_000
"""... and so many more in each. What goes through a message's data once costs none."""


class LimitError(ValueError):
    """An expression computes more than it may."""


class StepBudget:
    """The steps that an expression has left. ``reading`` is for what stands outside of loops."""

    __slots__ = ("left", "reading")

    def __init__(self) -> None:
        self.left = STEPS_MAX
        self.reading: StepBudget = _ReadingStepBudget(self)

    def spend(self, steps: int) -> None:
        """Take some away.

        :raises LimitError: there are not so many left.
        """
        self.left -= steps
        if self.left < 0:
            raise LimitError(f"it takes too many steps (more than {STEPS_MAX:,})")

    def make(self, size: int, *, text: bool = False) -> None:
        """Pay for a sequence, or a text, of so many items.

        :raises LimitError: that is too large.
        """
        if size > SIZE_MAX:
            what = "text" if text else "sequence"
            raise LimitError(f"it makes a {what} of {size:,} items (at most {SIZE_MAX:,})")
        self.spend(1 + (size >> 3 if text else size))


class _ReadingStepBudget(StepBudget):
    """Outside of loops, what goes through data once costs nothing; what is made costs always."""

    __slots__ = ("_paying",)

    def __init__(self, paying: StepBudget) -> None:
        self._paying = paying

    def spend(self, steps: int) -> None:
        """Take nothing away."""

    def make(self, size: int, *, text: bool = False) -> None:
        self._paying.make(size, text=text)


def within_limits(value: Any) -> Any:
    """Return a value that an operator or a function has made.

    :raises LimitError: it is a number of too many bits, or a complex one.
    """
    if type(value) is int and value.bit_length() > INT_BITS_MAX:
        raise LimitError(f"it makes a number of more than {INT_BITS_MAX} bits")
    if type(value) is complex:
        raise ValueError("it has no real value")
    return value


def spend_for(value: Any, budget: StepBudget) -> None:
    """Pay for what a value holds, nested sequences included.

    :raises LimitError: it holds too much.
    """
    kind = type(value)
    if kind is list or kind is tuple:
        left = [value]
        while left:
            one = left.pop()
            budget.spend(len(one) + 1)
            for item in one:
                if type(item) is list or type(item) is tuple:
                    left.append(item)
                elif type(item) not in _NUMBERS:
                    spend_for(item, budget)
    elif kind is str or kind is bytes:
        budget.spend((len(value) >> 3) + 1)
    elif kind.__module__ == "numpy" and value.ndim:
        budget.spend((value.nbytes >> 3) + 1)


_NUMBERS = frozenset((int, float, bool, type(None)))
