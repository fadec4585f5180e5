"""ROS parameter values as rcl takes them: flat dotted names, one type per list, 64-bit integers."""

from __future__ import annotations

from collections.abc import Iterator

from rsltrace.job.values.problem import JobProblem, JobProblems, Loc, describe

Scalar = bool | int | float | str
ParameterValue = Scalar | tuple[bool, ...] | tuple[int, ...] | tuple[float, ...] | tuple[str, ...]
"""A parameter's value. Lists are tuples, so that a job stays the same once it is built."""

INTEGER_MIN = -(2**63)
INTEGER_MAX = 2**63 - 1

_KINDS = ((bool, "bool"), (int, "integer"), (float, "float"), (str, "text"))


def flatten_parameters(values: object) -> dict[str, ParameterValue]:
    """Return ``{"nested.a": 1}`` for ``{"nested": {"a": 1}}``.

    Raises ``JobProblems`` with the place of each value that is not a ROS parameter value.
    """
    if not isinstance(values, dict):
        raise JobProblem(f"expected a mapping of parameter names to values, got {describe(values)}")
    flat: dict[str, ParameterValue] = {}
    problems: list[JobProblem] = []
    for name, loc, value in _leaves(values, "", (), problems):
        try:
            if name in flat:
                raise JobProblem(f"the parameter {name!r} is given twice", loc, at_key=True)
            flat[name] = _value(value, loc)
        except JobProblem as problem:
            problems.append(problem)
    if problems:
        raise JobProblems(problems)
    return flat


def _leaves(
    values: dict[object, object], prefix: str, loc: Loc, problems: list[JobProblem]
) -> Iterator[tuple[str, Loc, object]]:
    for key, value in values.items():
        place = (*loc, key if isinstance(key, (str, int)) else str(key))
        if not isinstance(key, str):
            problems.append(
                JobProblem(f"a parameter's name is text, got {describe(key)}", place, at_key=True)
            )
        elif key == "ros__parameters":
            problems.append(
                JobProblem(
                    "this looks like a ROS parameter file: list it in parameter_files, or put the "
                    "values directly below 'parameters'",
                    place,
                    at_key=True,
                )
            )
        elif not all(key.split(".")):
            # Names are otherwise free: qos_overrides./scan.publisher.depth is one.
            problems.append(
                JobProblem(
                    f"{key!r} is not a parameter name: a part before or after a '.' is empty",
                    place,
                    at_key=True,
                )
            )
        elif isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.", place, problems)
        else:
            yield f"{prefix}{key}", place, value


def _value(value: object, loc: Loc) -> ParameterValue:
    if isinstance(value, (list, tuple)):
        return _list(value, loc)
    return _scalar(value, loc)


def _list(values: list[object] | tuple[object, ...], loc: Loc) -> ParameterValue:
    elements = tuple(_scalar(value, (*loc, index)) for index, value in enumerate(values))
    for index, element in enumerate(elements):
        first = _kind(elements[0])
        if _kind(element) != first:
            hint = ""
            if {first, _kind(element)} == {"integer", "float"}:
                hint = "; write the integers with a decimal point"
            raise JobProblem(
                f"element {index} is {_with_article(_kind(element))}, element 0 is "
                f"{_with_article(first)}: rcl takes lists of one type{hint}",
                (*loc, index),
            )
    return elements  # type: ignore[return-value]  # one type, checked above


def _scalar(value: object, loc: Loc) -> Scalar:
    if isinstance(value, bool):
        return value
    if isinstance(value, int):
        if not INTEGER_MIN <= value <= INTEGER_MAX:
            raise JobProblem(f"{value} does not fit a ROS integer (64 bits, signed)", loc)
        return int(value)
    if isinstance(value, float):
        return float(value)
    if isinstance(value, str):
        return str(value)
    if value is None:
        raise JobProblem("no value is given, and a ROS parameter cannot be null", loc)
    raise JobProblem(
        f"a ROS parameter is true or false, a number, text, or a list of these; got "
        f"{describe(value)}",
        loc,
    )


def _kind(value: object) -> str:
    return next(name for kind, name in _KINDS if isinstance(value, kind))


def _with_article(kind: str) -> str:
    return {"integer": "an integer", "text": "text"}.get(kind, f"a {kind}")
