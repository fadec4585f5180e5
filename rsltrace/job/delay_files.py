"""The files that a job's delays may come from: measured values, series, and RSLCPP's delay table.

All are small text files; a mistake in one is reported with its line.
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

from rsltrace.errors import JobError
from rsltrace.job.delay import DelaySpec
from rsltrace.job.distribution import SamplesSpec, SeriesSpec, check_series
from rsltrace.job.names import check_topic
from rsltrace.job.times import parse_time

_MEASURED = (
    "MEASURED takes the delay from how long the callback ran on the wall clock, which is different "
    "in every run. Say what it is instead: give the callback's time in `execution:` (constant, a "
    "distribution, or samples that were measured once), or a delay of the topic in `delay: topics:`"
)


def read_samples(spec: SamplesSpec, path: Path) -> tuple[int, ...]:
    """Return the values of a file in nanoseconds.

    :raises JobError: with the line that is wrong.
    """
    values = []
    for number, line in _lines(path):
        try:
            values.append(parse_time(_with_unit(line, spec.unit)))
        except ValueError as error:
            raise JobError(str(error), where=f"{path.name}:{number}") from None
    if not values:
        raise JobError("it has no values: write one per line", where=path.name)
    return tuple(values)


def read_series(spec: SeriesSpec, path: Path) -> tuple[tuple[int, int], ...]:
    """Return the points of a file: (ns since the start, value in ns).

    :raises JobError: with the line that is wrong.
    """
    points: list[tuple[int, int]] = []
    for number, line in _lines(path):
        columns = [column.strip() for column in line.split(",")]
        if not points and columns and not any(character.isdigit() for character in line):
            continue  # a header
        try:
            if len(columns) != 2:
                raise ValueError(f"expected two columns, time and value, got {len(columns)}")
            at, value = (parse_time(_with_unit(column, spec.unit)) for column in columns)
            points.append((at, value))
            check_series(tuple(points[-2:]))
        except ValueError as error:
            raise JobError(str(error), where=f"{path.name}:{number}") from None
    if not points:
        raise JobError("it has no points: write 'time,value' lines", where=path.name)
    return tuple(points)


def read_rslcpp(path: Path) -> dict[str, DelaySpec]:
    """Return the delays of a table of RSLCPP: topic, FIXED or MEASURED, milliseconds, skew.

    The last line of a topic counts, as in RSLCPP; unlike there, a mistake is an error.

    :raises JobError: with the line that is wrong, and for MEASURED, which cannot be reproduced.
    """
    delays: dict[str, DelaySpec] = {}
    for number, line in _lines(path, comments=False):
        if number == 1:
            continue  # RSLCPP skips the header, whatever it says
        columns = [column.strip() for column in line.split(",")]
        try:
            if len(columns) < 3:
                raise ValueError(
                    "expected four columns: topic, FIXED, delay in ms, skew (empty for FIXED)"
                )
            topic, kind, delay = columns[:3]
            check_topic(topic)
            if kind == "MEASURED":
                raise ValueError(_MEASURED)
            if kind != "FIXED":
                raise ValueError(f"expected FIXED or MEASURED, got {kind!r}")
            if not delay:
                raise ValueError(f"the delay of {topic} in milliseconds is missing")
            delays[topic] = DelaySpec(constant=_truncated_ms(delay))
        except (ValueError, JobError) as error:
            raise JobError(str(error), where=f"{path.name}:{number}") from None
    return delays


def _truncated_ms(text: str) -> Any:
    """Return milliseconds as whole nanoseconds with their unit; RSLCPP cuts off what is finer."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"expected a delay in milliseconds, got {text!r}") from None
    if not value.is_finite() or value < 0 or value > 10**12:
        raise ValueError(f"a delay in milliseconds cannot be {text}")
    return f"{int(value * 1_000_000)}ns"


def _lines(path: Path, *, comments: bool = True) -> Iterator[tuple[int, str]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise JobError(
            f"not UTF-8: byte 0x{error.object[error.start]:02x}; a file of delays is text",
            where=path.name,
        ) from None
    except OSError as error:
        raise JobError(f"cannot be read: {error}", where=path.name) from None
    for number, line in enumerate(text.splitlines(), start=1):
        bare = (line.partition("#")[0] if comments else line).strip()
        if bare:
            yield number, bare


def _with_unit(value: str, unit: str) -> str:
    return value if value[-1:].isalpha() else f"{value}{unit}"
