"""The files that a job's delays may come from: measured values, series, and RSLCPP's delay table.

All are small text files; a mistake in one is shown with its line.
"""

from __future__ import annotations

import codecs
from collections.abc import Callable, Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TypeVar

from rsltrace.errors import JobError
from rsltrace.job.parts.delay import DelaySpec
from rsltrace.job.parts.distribution import SamplesSpec, SeriesSpec, check_series, check_short
from rsltrace.job.reading.yaml_source import TextPosition, YamlSource
from rsltrace.job.values.names import check_topic
from rsltrace.job.values.times import parse_measured
from rsltrace.simulation.chance.distribution import LONGEST_NS
from rsltrace.trace.model.regular_file import read_regular

_MEASURED = (
    "MEASURED takes the delay from how long the callback ran on the wall clock, which is different "
    "in every run. Say what it is instead: give the callback's time in `execution:` (constant, a "
    "distribution, or samples that were measured once), or a delay of the topic in `delay: topics:`"
)

_Row = TypeVar("_Row")


def read_samples(spec: SamplesSpec, path: Path, name: str) -> tuple[int, ...]:
    """Return the values of a file, which messages call ``name``, in nanoseconds.

    :raises JobError: with the line that is wrong.
    """

    def row(line: str) -> int:
        if len(line.replace(",", " ").replace(";", " ").split()) > 1 and not line[-1].isalpha():
            raise ValueError(f"expected one value per line, got {line!r}")
        if line.isidentifier() and line.lower() not in ("nan", "inf", "true", "false"):
            raise ValueError(f"expected a time, got {line!r}: a header is left out")
        return check_short(parse_measured(line, spec.unit), line)

    values = [value for _, value in _rows(path, name, row)]
    if not values:
        raise JobError("it has no values: write one per line", where=name)
    return tuple(values)


def read_series(spec: SeriesSpec, path: Path, name: str) -> tuple[tuple[int, int], ...]:
    """Return the points of a file: (ns since the start, value in ns).

    :raises JobError: with the line that is wrong.
    """
    points: list[tuple[int, int]] = []

    def row(line: str) -> None:
        columns = [column.strip() for column in line.split(",")]
        if len(columns) != 2:
            raise ValueError(
                f"expected two columns with a comma in between, time and value, got {line!r}"
            )
        at_ns = parse_measured(columns[0], spec.unit)
        value_ns = check_short(parse_measured(columns[1], spec.unit), columns[1])
        points.append((at_ns, value_ns))
        check_series(tuple(points[-2:]))

    for _ in _rows(path, name, row, header=_is_header):
        pass
    if not points:
        raise JobError("it has no points: write 'time,value' lines", where=name)
    return tuple(points)


def read_rslcpp(path: Path, name: str) -> dict[str, tuple[int, DelaySpec]]:
    """Return the delays of a table of RSLCPP (topic, FIXED or MEASURED, milliseconds, skew), by
    topic, with the numbers of their lines.

    The last line of a topic counts, as in RSLCPP; unlike there, a mistake is an error.

    :raises JobError: with the line that is wrong, and for MEASURED, which cannot be reproduced.
    """

    def row(line: str) -> tuple[str, DelaySpec]:
        columns = [column.strip() for column in line.split(",")]
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
        return topic, DelaySpec(constant_ns=_truncated_ms(delay))

    def header(line: str) -> bool:
        if [column.strip() for column in line.split(",")[1:2]] in (["FIXED"], ["MEASURED"]):
            raise ValueError(
                "the first line is a header, which RSLCPP skips whatever it says, and this one has "
                "a delay: put a header above it"
            )
        return True

    rows = _rows(path, name, row, header=header, only_first=True, comments=False)
    found = {topic: (number, delay) for number, (topic, delay) in rows}
    if not found:
        raise JobError(
            "it has no delays: below its header, write 'topic,FIXED,milliseconds,' lines",
            where=name,
        )
    return found


def _truncated_ms(text: str) -> int:
    """Return milliseconds as whole nanoseconds; RSLCPP cuts off what is finer."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"expected a delay in milliseconds, got {text!r}") from None
    if not value.is_finite() or not 0 <= value * 1_000_000 <= LONGEST_NS:
        raise ValueError(f"a delay in milliseconds cannot be {text}")
    return int(value * 1_000_000)


def _is_header(line: str) -> bool:
    """Say whether no column of a line is a time."""
    return not any(column.strip()[:1].isdigit() for column in line.split(","))


def _rows(
    path: Path,
    name: str,
    row: Callable[[str], _Row],
    *,
    header: Callable[[str], bool] = lambda _: False,
    only_first: bool = False,
    comments: bool = True,
) -> Iterator[tuple[int, _Row]]:
    """Yield (number of the line, what ``row`` makes of it).

    The first line that says something may be a ``header``; with ``only_first``, line 1 alone.
    """
    source = YamlSource(name, _text(path, name))
    may_be_header = True
    for number, line in enumerate(source.text.splitlines(), start=1):
        bare = (line.partition("#")[0] if comments else line).strip()
        if not bare:
            continue
        try:
            is_header = may_be_header and (number == 1 or not only_first) and header(bare)
            may_be_header = False
            if not is_header:
                yield number, row(bare)
        except (ValueError, JobError) as error:
            raise source.error(str(error), TextPosition(number, line.index(bare[0]) + 1)) from None


def _text(path: Path, name: str) -> str:
    try:
        data = read_regular(path)
    except OSError as error:
        raise JobError(f"cannot be read: {error.strerror or error}", where=name) from None
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise JobError("this is UTF-16; save the file as UTF-8 text", where=name)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise JobError(
            f"not UTF-8: byte 0x{data[error.start]:02x}; a file of delays is text",
            where=f"{name}:{line}",
        ) from None
