"""What is wrong with a job, apart from where it was written: findings, their places, their words.

Validators raise ``Problem`` (a ``ValueError``, so pydantic collects it with its own findings);
``problems_of`` turns everything pydantic found into problems worded for the author of a job.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from pydantic import BaseModel, ValidationError

Loc = tuple["str | int", ...]
"""A place in a job as keys and list indices: ``("nodes", 0, "name")``."""


class Problem(ValueError):
    """One finding. ``loc`` is relative to the value being validated; ``at_key`` blames the key."""

    def __init__(self, message: str, loc: Loc = (), *, at_key: bool = False) -> None:
        super().__init__(message)
        self.message = message
        self.loc = loc
        self.at_key = at_key


class Problems(ValueError):
    """Several findings of one validator."""

    def __init__(self, items: list[Problem]) -> None:
        super().__init__("; ".join(item.message for item in items))
        self.items = items


def format_loc(loc: Loc) -> str:
    """Return ``nodes[0].parameters.rate`` for ``("nodes", 0, "parameters", "rate")``."""
    text = ""
    for part in loc:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def describe(value: object) -> str:
    """Name a value as it looks in YAML: ``true``, ``nothing``, ``text 'abc'``, ``a list``."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"text {value!r}"
    if isinstance(value, (int, float)):
        return f"the number {getattr(value, 'text', value)}"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    return f"an object of {type(value).__name__}"


def nearest(word: str, names: Iterable[str]) -> str | None:
    """Return the name that ``word`` was most probably meant to be: one of the same letters, or
    the most similar one; None if none is near."""
    close = difflib.get_close_matches(word, list(names), n=3)
    swapped = [name for name in close if sorted(name) == sorted(word)]
    return next(iter([*swapped, *close]), None)


def unknown_key(key: object, valid: Iterable[str], loc: Loc) -> Problem:
    """Return the finding that ``key``, below ``loc``, is none of the ``valid`` keys."""
    names = list(valid)
    inside = f" in {format_loc(loc)}" if loc else ""
    near = nearest(str(key), names)
    advice = f"did you mean {near!r}?" if near else f"valid keys are {', '.join(names)}"
    place = key if isinstance(key, (str, int)) else str(key)
    return Problem(f"unknown key {key!r}{inside}; {advice}", (*loc, place), at_key=True)


def problems_of(error: ValidationError, model: type[BaseModel]) -> list[Problem]:
    """Return the findings of a failed validation of ``model``, worded and with full locations."""
    found: list[Problem] = []
    entries = error.errors(include_url=False)
    # A misspelt key is one mistake, not two: the key that it was meant to be is not missing.
    meant = {
        (*entry["loc"][:-1], nearest(str(entry["loc"][-1]), _keys_at(model, entry["loc"][:-1])))
        for entry in entries
        if entry["type"] == "extra_forbidden"
    }
    for entry in entries:
        loc: Loc = entry["loc"]
        cause = entry.get("ctx", {}).get("error")
        if isinstance(cause, (Problem, Problems)):
            items = cause.items if isinstance(cause, Problems) else [cause]
            found += [_named(item.message, loc + item.loc, at_key=item.at_key) for item in items]
        elif entry["type"] == "extra_forbidden":
            found.append(unknown_key(loc[-1], _keys_at(model, loc[:-1]), loc[:-1]))
        elif entry["type"] == "missing" and loc in meant:
            continue
        elif entry["type"] == "missing":
            inside = f"{format_loc(loc[:-1])}: " if loc[:-1] else ""
            found.append(Problem(f"{inside}the key '{loc[-1]}' is missing", loc))
        else:
            text = _wording(entry["type"], entry["msg"], cause, entry["input"])
            is_part = entry["type"].startswith("model_") and not isinstance(cause, ValueError)
            if is_part and isinstance(entry["input"], (str, int, float, list, tuple)):
                keys = _keys_at(model, loc)
                text += f"; its keys are {', '.join(keys)}" if keys else ""
            found.append(_named(text, loc))
    return found


def _named(message: str, loc: Loc, *, at_key: bool = False) -> Problem:
    place = format_loc(loc[:-1] if at_key else loc)
    return Problem(f"{place}: {message}" if place else message, loc, at_key=at_key)


def _wording(kind: str, message: str, cause: object, value: object) -> str:
    if isinstance(cause, ValueError):
        return str(cause)
    expected = {
        "model_type": "a mapping",
        "model_attributes_type": "a mapping",
        "dict_type": "a mapping",
        "tuple_type": "a list",
        "int_type": "an integer",
        "bool_type": "true or false",
        "string_type": "text",
    }.get(kind)
    return f"expected {expected}, got {describe(value)}" if expected else message


def _keys_at(model: type[BaseModel], loc: Loc) -> list[str]:
    """Return the keys a job may have at ``loc``, found by walking the models' annotations."""
    from rsltrace.job.model import field_at, file_fields, models_in

    models = [model]
    if loc:
        field = field_at(model, loc)
        assert field is not None, "extra keys can only be forbidden inside a model"
        models = models_in(field.annotation)
    return [key for inner in models for key, _ in file_fields(inner)]
