"""``dataclass(frozen=True, slots=True)`` in a fifth of the time: a command makes a hundred of them.

Python's compiles seven functions for each class; here all but ``__init__`` are shared. Making an
object takes longer, so classes of events and messages are Python's. Type checkers see Python's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from operator import attrgetter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(cls=None, /, **options):
        """Return a class or a decorator of classes, as Python's does."""
        if options != {"frozen": True, "slots": True}:
            return dataclasses.dataclass(cls, **options)
        made = dataclasses.dataclass(eq=False, repr=False, slots=True)

        def decorate(cls):
            cls = made(cls)
            compared = [field.name for field in dataclasses.fields(cls) if field.compare]
            cls._compared = _values(compared)
            for name, shared in _SHARED.items():
                if name not in vars(cls):
                    setattr(cls, name, shared)
            return cls

        return decorate


def _values(names: list[str]) -> Callable[[Any], Any]:
    """Return a function from an object to the tuple of some of its attributes."""
    if len(names) > 1:
        return attrgetter(*names)
    return lambda self: tuple(getattr(self, name) for name in names)


def _equal(self: Any, other: Any) -> Any:
    cls: Any = self.__class__
    return cls._compared(self) == cls._compared(other) if type(other) is cls else NotImplemented


def _hash(self: Any) -> int:
    return hash(self.__class__._compared(self))


def _text(self: Any) -> str:
    shown = (field.name for field in dataclasses.fields(self) if field.repr)
    return f"{type(self).__qualname__}({', '.join(f'{n}={getattr(self, n)!r}' for n in shown)})"


def _set(self: Any, name: str, value: object) -> None:
    if hasattr(self, name):  # what __init__ has not set yet is not
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")
    object.__setattr__(self, name, value)


def _delete(self: Any, name: str) -> None:
    raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")


_SHARED = {
    "__eq__": _equal,
    "__hash__": _hash,
    "__repr__": _text,
    "__setattr__": _set,
    "__delattr__": _delete,
}
