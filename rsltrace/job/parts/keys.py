"""The keys of a job as the models have them: walked for messages, overrides, schema and docs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from importlib import import_module
from typing import Any, ClassVar, get_args, get_origin

from rsltrace.job.parts.field import FrozenFields, PartField
from rsltrace.job.values.problem import Loc


class LaterPart:
    """Stands in annotations for a part whose module is imported for the jobs that have the part."""

    HOME: ClassVar[str]

    @classmethod
    def model(cls) -> type[FrozenFields]:
        found: type[FrozenFields] = getattr(import_module(cls.HOME), cls.__name__)
        return found


def later(home: str, *names: str) -> dict[str, type[LaterPart]]:
    """Return what stands for the parts of a module, by name."""
    return {name: type(name, (LaterPart,), {"HOME": home}) for name in names}


def model_of(annotation: Any) -> type[FrozenFields] | None:
    """Return the model that an annotation is, if it is one."""
    if not isinstance(annotation, type) or get_args(annotation):
        return None  # in Python 3.10 tuple[X, ...] calls itself a type
    if issubclass(annotation, LaterPart):
        return annotation.model()
    return annotation if issubclass(annotation, FrozenFields) else None


def file_fields(model: type[FrozenFields]) -> Iterator[tuple[str, PartField]]:
    """Yield (key in a job file, field) of a model, in order."""
    for name, field in model.fields.items():
        if not field.exclude:
            yield field.alias or name, field


def models_in(annotation: Any) -> list[type[FrozenFields]]:
    """Return the models that values of an annotation may be made of."""
    if inner := get_args(annotation):
        return [found for argument in inner for found in models_in(argument)]
    model = model_of(annotation)
    return [] if model is None else [model]


def keys_with(model: type[FrozenFields], key: str) -> list[str]:
    """Return the keys of a model whose parts have a key of that name."""
    return [
        own
        for own, field in file_fields(model)
        if any(key == name for part in models_in(field.annotation) for name, _ in file_fields(part))
    ]


def field_at(model: type[FrozenFields], loc: Loc) -> PartField | None:
    """Return the field that governs the value at ``loc``, or None below free-form values."""
    models, found = [model], None
    in_mapping = False
    for part in loc:
        if isinstance(part, int) or in_mapping:
            in_mapping = False  # a list's index, or a key that the author has chosen
            continue
        fields = [field for m in models for key, field in file_fields(m) if key == part]
        if fields:
            found = fields[0]
            models = models_in(found.annotation)
            in_mapping = bool(models) and get_origin(found.annotation) is dict
        elif not models:
            return None
    return found


def alternatives_at(model: type[FrozenFields], loc: Loc) -> tuple[tuple[str, ...], ...]:
    """Return the sets of keys of the value at ``loc`` of which only one may be given."""
    field = field_at(model, loc) if loc else None
    models = [] if field is None else models_in(field.annotation)
    return next((m.ALTERNATIVES for m in models if hasattr(m, "ALTERNATIVES")), ())


def without_alternatives(
    values: dict[Any, Any], keys: Iterable[Any], model: type[FrozenFields], loc: Loc
) -> dict[Any, Any]:
    """Return ``values`` without what cannot stay beside the new ``keys``: another distribution
    takes the place of the one that was there."""
    alternatives = alternatives_at(model, loc)
    given = {key for key in keys if isinstance(key, str)}
    chosen = [set(group) for group in alternatives if given & set(group)]
    gone = {key for group in alternatives for key in group if chosen} - set().union(*chosen)
    return {key: value for key, value in values.items() if key not in gone}


def is_list_at(model: type[FrozenFields], loc: Loc) -> bool:
    """Say whether the value at ``loc`` is a list and nothing else."""
    field = field_at(model, loc) if loc else None
    if field is None or field is field_at(model, loc[:-1]):
        return False  # free-form values, or an entry of a list or mapping
    kinds = [kind for kind in get_args(field.annotation) if get_origin(kind) is tuple]
    return get_origin(field.annotation) is tuple or bool(kinds)


def attached(field: PartField, name: str) -> Any:
    """Return what a field's check says about itself under ``name``, or None."""
    for item in field.checks:
        value = getattr(item, name, None)
        if value is not None:
            return value
    return None


def shorthand_at(model: type[FrozenFields], loc: Loc) -> str | None:
    """Return the key that text alone stands for at ``loc``, if it does."""
    field = field_at(model, loc)
    if field is None or not loc:
        return None
    around = field_at(model, loc[:-1])
    if isinstance(loc[-1], int):
        fact = "entry_shorthand"
    else:
        # An entry of a mapping has the field of the mapping itself.
        fact = "value_shorthand" if around is field else "shorthand"
    value = attached(field, fact)
    return None if value is None else str(value)
