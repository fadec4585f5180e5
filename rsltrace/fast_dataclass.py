"""``dataclass`` in a tenth of the time: a command makes a hundred of them.

Python's compiles up to seven functions for each class. Here one ``__init__`` is compiled for each
number of fields and copied with their names, and the rest is shared. What ``dataclasses.fields``
tells is made when it is asked for. Type checkers see Python's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from operator import attrgetter
from types import FunctionType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(cls=None, /, *, eq=True, frozen=False, slots=False, **others):
        """Return a class or a decorator of classes, as Python's does."""
        if others:
            return _pythons(cls, eq=eq, frozen=frozen, slots=slots, **others)
        options = {"eq": eq, "frozen": frozen, "slots": slots}
        return partial(_decorate, **options) if cls is None else _decorate(cls, **options)


_pythons = dataclasses.dataclass
_assign = object.__setattr__
_NO_DEFAULT = object()


class _Factory:
    """The default of a field whose value is made for each object."""

    def __init__(self, make: Callable[[], object]) -> None:
        self.make = make


def _decorate(cls: Any, *, eq: bool, frozen: bool, slots: bool) -> Any:
    body = {k: v for k, v in vars(cls).items() if k not in ("__dict__", "__weakref__")}
    inherited = getattr(cls, "_plain_fields", None) or {}
    fields = _plain_fields(cls, body)
    made = cls
    if fields is None:
        own_init = frozen and not slots  # it must set what the class has, its defaults
        made = _pythons(eq=False, repr=False, frozen=own_init, slots=slots)(cls)
        compared = [field.name for field in dataclasses.fields(made) if field.compare]
    else:
        compared = [*fields]
        defaults = tuple(v for v in fields.values() if v is not _NO_DEFAULT)
        init = _init(fields, defaults, frozen=frozen, more=hasattr(cls, "__post_init__"))
        init.__qualname__ = f"{cls.__qualname__}.__init__"
        own = {
            "__init__": init,
            "__match_args__": tuple(fields),
            "__dataclass_fields__": _Description(
                partial(cls.__class__, cls.__name__, cls.__bases__, body)
            ),
        }
        if slots:
            kept = {k: v for k, v in body.items() if k not in fields}
            own["__slots__"] = [name for name in fields if name not in inherited]
            made = cls.__class__(cls.__name__, cls.__bases__, own | kept)
            made.__qualname__ = cls.__qualname__
        else:
            for name, value in body.items():
                if isinstance(value, dataclasses.Field):
                    delattr(made, name)
                    if value.default is not dataclasses.MISSING:
                        own[name] = value.default
            for name, value in own.items():
                setattr(made, name, value)
            vars(made)["__dataclass_fields__"].__set_name__(made, "")
    shared: dict[str, Any] = {"__repr__": _text}
    if eq:
        shared |= {"__eq__": _equal, "__hash__": _hash if frozen else None}
    if frozen:
        shared |= {"__setattr__": _set, "__delattr__": _delete}
    for name, value in shared.items():
        if name not in vars(made):
            setattr(made, name, value)
    made._plain_fields = fields
    made._compared = _values(compared)
    return made


def _plain_fields(cls: Any, body: dict[str, Any]) -> dict[str, object] | None:
    """Return the fields and their defaults, or None if there is more to them."""
    fields: dict[str, object] | None = getattr(cls, "_plain_fields", None)
    if fields is None:
        fields = {}
        if hasattr(cls, "__dataclass_fields__"):
            return None
    own = [name for name, text in cls.__annotations__.items() if "ClassVar" not in str(text)]
    given = [body[name] for name in own if name in body]
    if any(
        not value.init or not value.compare or value.hash is not None or value.kw_only is True
        if isinstance(value, dataclasses.Field)
        else value.__hash__ is None
        for value in given
    ):
        return None
    fields = fields | {name: _default(body.get(name, _NO_DEFAULT)) for name in own}
    defaults = [value is not _NO_DEFAULT for value in fields.values()]
    return fields if sorted(defaults) == defaults else None


def _default(value: object) -> object:
    if not isinstance(value, dataclasses.Field):
        return value
    if value.default_factory is not dataclasses.MISSING:
        return _Factory(value.default_factory)
    return _NO_DEFAULT if value.default is dataclasses.MISSING else value.default


class _Description:
    """What Python's dataclass tells of a class, made when it is asked for."""

    def __init__(self, plain: Callable[[], type]) -> None:
        self._plain = plain

    def __set_name__(self, owner: type, name: str) -> None:
        self._owner = owner

    def __get__(self, instance: object, cls: type) -> Any:
        made: Any = _pythons(eq=False, repr=False, slots=True)(self._plain())
        self._owner.__dataclass_params__ = made.__dataclass_params__  # type: ignore[attr-defined]
        self._owner.__dataclass_fields__ = made.__dataclass_fields__  # type: ignore[attr-defined]
        return made.__dataclass_fields__


def _init(
    fields: dict[str, object], defaults: tuple[object, ...], *, frozen: bool, more: bool
) -> FunctionType:
    """Return an ``__init__`` that sets the attributes of these names; ``more``: and then calls
    ``__post_init__``."""
    made = tuple(place for place, value in enumerate(fields.values()) if type(value) is _Factory)
    code = _template(len(fields), frozen, made, more).__code__
    given = {f"_{place}": name for place, name in enumerate(fields)}
    code = code.replace(
        co_varnames=("self", *fields),
        co_names=tuple(given.get(name, name) for name in code.co_names),
        co_consts=tuple(given.get(constant, constant) for constant in code.co_consts),
    )
    return FunctionType(code, globals(), "__init__", defaults)


@cache
def _template(count: int, frozen: bool, made: tuple[int, ...], more: bool) -> FunctionType:
    names = [f"_{place}" for place in range(count)]
    lines = [f"    if type(_{at}) is _Factory: _{at} = _{at}.make()" for at in made]
    lines += [
        f"    _assign(self, {name!r}, {name})" if frozen else f"    self.{name} = {name}"
        for name in names
    ]
    lines.append("    self.__post_init__()" if more else "    pass")
    scope: dict[str, FunctionType] = {}
    exec("\n".join([f"def __init__({', '.join(['self', *names])}):", *lines]), scope)
    return scope["__init__"]


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
    body = vars(type(self))
    # Slots that are not there yet are set by copies, and by an __init__ of Python.
    if hasattr(self, name) or ("_compared" in body and "__slots__" not in body):
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")
    object.__setattr__(self, name, value)


def _delete(self: Any, name: str) -> None:
    raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")
