"""What is wrong with a job, apart from where it was written: findings, their places, their words.

Validators raise ``Problem`` (a ``ValueError``, so pydantic collects it with its own findings);
``problems_of`` turns everything pydantic found into problems worded for the author of a job.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

from pydantic import BaseModel, ValidationError

_VARIABLE = re.compile(r"\$\{?([A-Za-z_][A-Za-z0-9_]*)\}?")

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


_BY_NAME = ("topics", "nodes")
"""Keys below which names stand as keys."""


def unknown_key(
    key: object, valid: Iterable[str], loc: Loc, *, below: Iterable[str] = ()
) -> Problem:
    """Return the finding that ``key``, below ``loc``, is none of the ``valid`` keys; ``below`` are
    those of them that have such a key."""
    below = list(below)
    names = list(valid)
    inside = f" in {format_loc(loc)}" if loc else ""
    text = str(key)
    near = meant_by(text, names) or nearest(text, names)
    glued, colon, value = text.replace("\xa0", " ").partition(":")
    if colon and glued in names:
        advice = f"put a blank after the colon: '{glued}: {value.strip()}'"
    elif near:
        advice = f"did you mean {near!r}?"
    elif text.startswith("/") and (part := next((n for n in _BY_NAME if n in names), None)):
        advice = f"names of {part} go below '{part}:'"
    elif below:
        advice = f"it goes below {' or '.join(f'{key!r}' for key in below)}"
    else:
        advice = f"valid keys are {', '.join(names)}"
    shown = repr(key) if isinstance(key, str) else describe(key).removeprefix("the number ")
    place = key if isinstance(key, (str, int)) else text
    return Problem(f"unknown key {shown}{inside}; {advice}", (*loc, place), at_key=True)


_OTHER_WORDS = {
    "mean": ("mu", "average", "avg", "loc"),
    "sd": ("std", "stddev", "std_dev", "sigma", "stdev", "deviation"),
    "min": ("low", "lower", "from", "a"),
    "max": ("high", "upper", "to", "b"),
    "shape": ("alpha", "k"),
    "scale": ("theta",),
    "good_to_bad": ("p",),
    "bad_to_good": ("r", "q"),
    "drop": ("loss", "lose", "p", "probability"),
    "default": ("constant", "all", "delay"),
    "node": ("class", "plugin", "component"),
    "executable": ("exec", "package", "pkg"),
    "namespace": ("ns",),
    "arguments": ("args", "kwargs", "argv"),
    "quiescence": ("quiet", "silence", "idle"),
    "workers": ("threads",),
    "file": ("path", "filename", "csv"),
    "path": ("file", "bag", "uri"),
    "from": ("start", "begin", "since", "sender", "publisher", "source", "src"),
    "to": ("end", "until", "stop", "receiver", "subscriber", "subscription", "destination", "dst"),
    "permutation": ("random", "shuffle", "shuffled"),
    "rate_monotonic": ("rm", "rms"),
    "at": ("time", "when"),
    "by": ("size", "jump"),
}
"""Words that other programs have for a key."""


def meant_by(word: str, names: Iterable[str]) -> str | None:
    """Return the name that is called ``word`` elsewhere, if there is one."""
    return next((name for name in names if word in _OTHER_WORDS.get(name, ())), None)


def problems_of(error: ValidationError, model: type[BaseModel]) -> list[Problem]:
    """Return the findings of a failed validation of ``model``, worded and with full locations."""
    found: list[Problem] = []
    entries = error.errors(include_url=False)
    # A misspelt key is one mistake, not two: the key that it was meant to be is not missing.
    meant = {
        (*entry["loc"][:-1], near)
        for entry in entries
        if entry["type"] == "extra_forbidden"
        for names in (_keys_at(model, entry["loc"][:-1]),)
        for near in (meant_by(str(entry["loc"][-1]), names), nearest(str(entry["loc"][-1]), names))
    }
    for entry in entries:
        loc: Loc = entry["loc"]
        cause = entry.get("ctx", {}).get("error")
        if isinstance(cause, (Problem, Problems)):
            items = cause.items if isinstance(cause, Problems) else [cause]
            hint = _as_variable(entry["input"])
            found += [
                _named(item.message + hint, loc + item.loc, at_key=item.at_key) for item in items
            ]
        elif entry["type"] == "extra_forbidden":
            found.append(unknown_key(loc[-1], _keys_at(model, loc[:-1]), loc[:-1]))
        elif entry["type"] == "missing" and loc in meant:
            continue
        elif entry["type"] == "missing":
            inside = f"{format_loc(loc[:-1])}: " if loc[:-1] else ""
            found.append(Problem(f"{inside}the key '{loc[-1]}' is missing", loc))
        else:
            text = _wording(entry["type"], entry["msg"], cause, entry["input"])
            text += _as_variable(entry["input"])
            is_part = entry["type"].startswith("model_") and not isinstance(cause, ValueError)
            if is_part and isinstance(entry["input"], (str, int, float, list, tuple)):
                keys = _keys_at(model, loc)
                text += f"; its keys are {', '.join(keys)}" if keys else ""
                text += _as_part(entry["input"], _models_at(model, loc))
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
    hint = as_flag(value) if kind == "bool_type" else ""
    return f"expected {expected}, got {describe(value)}{hint}" if expected else message


def as_flag(value: object) -> str:
    """Say how to write true or false: YAML 1.2 knows neither ``yes`` nor ``on``."""
    word = value.lower() if isinstance(value, str) else None
    if word in ("yes", "on", "y", "true"):
        return "; write true"
    return "; write false" if word in ("no", "off", "n", "false") else ""


def _as_variable(value: object) -> str:
    """Say how to write an environment variable, if a shell would take a text for one."""
    found = _VARIABLE.search(value) if isinstance(value, str) else None
    return f"; an environment variable is $(env {found[1]})" if found else ""


def _as_part(value: object, models: list[type[BaseModel]]) -> str:
    """Say how to write what was meant: ``stop: 60s`` is ``{duration: 60s}``."""
    for inner in models:
        keys: tuple[str, ...] = getattr(inner, "LISTED", ())
        if isinstance(value, (list, tuple)) and len(value) == len(keys):
            values = ", ".join(f"{k}: {_written(v)}" for k, v in zip(keys, value, strict=True))
            return f"; write {{{values}}}"
        key: str | None = getattr(inner, "MEANT", None)
        if hasattr(inner, "meant_key") and isinstance(value, str):
            key = inner.meant_key(value)
        wanted = (list, tuple) if getattr(inner, "MEANT_LIST", False) else (str, int, float)
        if key is not None and isinstance(value, wanted) and not isinstance(value, bool):
            return f"; write {{{key}: {_written(value)}}}"
    return ""


def _written(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_written, value))}]"
    return str(getattr(value, "text", value))


def _keys_at(model: type[BaseModel], loc: Loc) -> list[str]:
    """Return the keys a job may have at ``loc``."""
    from rsltrace.job.documents.keys import file_fields

    return [key for inner in _models_at(model, loc) for key, _ in file_fields(inner)]


def _models_at(model: type[BaseModel], loc: Loc) -> list[type[BaseModel]]:
    """Return the parts that may be at ``loc``, found by walking the models' annotations."""
    from rsltrace.job.documents.keys import field_at, models_in

    if not loc:
        return [model]
    field = field_at(model, loc)
    assert field is not None, "extra keys can only be forbidden inside a model"
    return models_in(field.annotation)
