"""A key of a part of a job: its type and checks, its default, and what the documentation says."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from typing_extensions import Self

_NONE: Any = object()


class PartField:
    """What a part says about one of its keys. An attribute of the part's class."""

    annotation: Any
    """The type of the checked value."""
    checks: tuple[Callable[[object, bool], object], ...]
    """Checks: from what is given, and whether a file gives it, to the value."""

    def __init__(
        self,
        default: Any = _NONE,
        *,
        default_factory: Callable[[], Any] | None = None,
        alias: str | None = None,
        description: str = "",
        examples: list[Any] | None = None,
        exclude: bool = False,
        repr: bool = True,
    ) -> None:
        self._default = default
        self._default_factory = default_factory
        self.alias = alias
        self.description = description
        self.examples = examples or []
        self.exclude = exclude
        self.repr = repr

    def is_required(self) -> bool:
        """Whether the key must be given."""
        return self._default is _NONE and self._default_factory is None

    def get_default(self) -> Any:
        """Return the value where the key is not given."""
        return self._default if self._default_factory is None else self._default_factory()


Field: Callable[..., Any] = PartField
"""Makes a key, which type checkers take for its value."""


class _Fields:
    """The fields of a class by name, those of its base classes first; found when first used."""

    def __get__(self, part: object, cls: type[FrozenFields]) -> dict[str, PartField]:
        if "_fields" not in vars(cls):
            cls._fields = dict(_fields(cls))
        return cls._fields


def _fields(cls: type) -> Iterator[tuple[str, PartField]]:
    hints = get_type_hints(cls, include_extras=True)
    for base in reversed(cls.__mro__):
        for name, field in vars(base).items():
            if isinstance(field, PartField):
                is_checked = get_origin(hints[name]) is Annotated
                field.annotation, *checks = get_args(hints[name]) if is_checked else [hints[name]]
                field.checks = tuple(checks)
                yield name, field


class FrozenFields:
    """Has a value for each of its fields, and cannot be changed."""

    fields: ClassVar[Mapping[str, PartField]] = _Fields()  # type: ignore[assignment]
    _fields: ClassVar[dict[str, PartField]]
    _given: frozenset[str]

    @property
    def given_fields(self) -> set[str]:
        """The fields whose values were given."""
        return set(self._given)

    def with_values(self, **changes: Any) -> Self:
        """Return a copy with other values of some fields, which are not checked."""
        made = object.__new__(type(self))
        given = self._given | changes.keys()
        vars(made).update({**vars(self), **changes, "_given": given})
        return made

    def _values(self) -> list[Any]:
        return [getattr(self, name) for name in self.fields]

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{name}: a {type(self).__name__} is frozen")

    __delattr__ = __setattr__  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return self._values() == other._values()

    def __hash__(self) -> int:
        return hash((type(self), *self._values()))

    def __repr__(self) -> str:
        shown = (name for name, field in self.fields.items() if field.repr)
        return f"{type(self).__name__}({', '.join(f'{n}={getattr(self, n)!r}' for n in shown)})"
