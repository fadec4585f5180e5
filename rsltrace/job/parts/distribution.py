"""How long something takes, as a job says it: for delays and for execution times."""

from __future__ import annotations

from typing import Annotated, ClassVar

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import (
    attach,
    check,
    flag,
    given,
    items,
    number,
    one_of,
    positive_time,
)
from rsltrace.job.values.mappings import check_path
from rsltrace.job.values.problem import JobProblem
from rsltrace.job.values.times import TIME_SCHEMA, UNITS_NS, parse_time
from rsltrace.simulation.chance.distribution import LONGEST_NS

SAMPLE_UNITS = tuple(UNITS_NS)


def parse_short_time(value: object) -> int:
    """Return a time that something may take, in nanoseconds."""
    return check_short(parse_time(value), getattr(value, "text", value))


def check_short(time_ns: int, shown: object) -> int:
    """Return ``time_ns`` unless it is longer than anything takes."""
    if time_ns > LONGEST_NS:
        raise ValueError(f"{shown} is too long: at most {LONGEST_NS // UNITS_NS['h']}h")
    return time_ns


attach(parse_short_time, schema=TIME_SCHEMA)


class UniformSpec(JobPart):
    """Uniform between two bounds."""

    LISTED: ClassVar[tuple[str, ...]] = ("min", "max")

    min_ns: Annotated[int, check(parse_short_time)] = Field(
        alias="min", description="Shortest time.", examples=["1ms"]
    )
    max_ns: Annotated[int, check(parse_short_time)] = Field(
        alias="max", description="Longest time.", examples=["3ms"]
    )

    @after_fields
    def _in_order(self) -> None:
        if self.max_ns < self.min_ns:
            raise JobProblem("max is less than min", ("max",))


class NormalSpec(JobPart):
    """Normal, truncated at zero: negative values are drawn again."""

    LISTED: ClassVar[tuple[str, ...]] = ("mean", "sd")

    mean_ns: Annotated[int, check(parse_time)] = Field(
        alias="mean", description="Mean before the truncation.", examples=["5ms"]
    )
    sd_ns: Annotated[int, check(parse_time)] = Field(
        alias="sd", description="Standard deviation before the truncation.", examples=["1ms"]
    )


class _ByMeanSpec(JobPart):
    """By mean and standard deviation, or in another way."""

    ALTERNATIVES: ClassVar[tuple[tuple[str, ...], ...]]

    mean_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None, alias="mean", description="Mean; goes with `sd`.", examples=["5ms"]
    )
    sd_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None, alias="sd", description="Standard deviation.", examples=["2ms"]
    )

    @after_fields
    def _one_way(self) -> None:
        one, other = self.ALTERNATIVES
        fields = type(self).fields.items()
        given = {field.alias or name for name, field in fields if getattr(self, name) is not None}
        if given not in (set(one), set(other)):
            raise JobProblem(f"give either {' and '.join(one)}, or {' and '.join(other)}")


class LognormalSpec(_ByMeanSpec):
    """Lognormal: by mean and standard deviation, or by median and sigma of the logarithm."""

    ALTERNATIVES: ClassVar[tuple[tuple[str, ...], ...]] = (("mean", "sd"), ("median", "sigma"))

    median_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None, alias="median", description="Median; goes with `sigma`.", examples=["5ms"]
    )
    sigma: Annotated[float | None, check(number(0, 10, open_below=True), optional=True)] = Field(
        default=None,
        description="Standard deviation of the natural logarithm.",
        examples=[0.5],
    )


class GammaSpec(_ByMeanSpec):
    """Gamma: by mean and standard deviation, or by shape and scale."""

    ALTERNATIVES: ClassVar[tuple[tuple[str, ...], ...]] = (("mean", "sd"), ("shape", "scale"))

    shape: Annotated[float | None, check(number(0, 1e9, open_below=True), optional=True)] = Field(
        default=None, description="Shape; goes with `scale`.", examples=[2.0]
    )
    scale_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None, alias="scale", description="Scale.", examples=["1ms"]
    )


class SamplesSpec(JobPart):
    """Measured values with equal probabilities, in a list or a file."""

    ALTERNATIVES: ClassVar[tuple[tuple[str, ...], ...]] = (("values",), ("file", "unit"))
    MEANT: ClassVar[str] = "values"
    MEANT_LIST: ClassVar[bool] = True

    values_ns: Annotated[tuple[int, ...] | None, check(items(parse_short_time), optional=True)] = (
        Field(
            default=None, alias="values", description="The values.", examples=[["4.8ms", "5.1ms"]]
        )
    )
    file: Annotated[str | None, check(check_path, optional=True)] = Field(
        default=None,
        description="Text file with one value per line.",
        examples=["delays.txt"],
    )
    unit: Annotated[str, check(one_of(*SAMPLE_UNITS))] = Field(
        default="s",
        description="Unit of values without one.",
        examples=["ms"],
    )

    @after_fields
    def _one_source(self) -> None:
        if (self.values_ns is None) == (self.file is None):
            raise JobProblem("give either values or a file")
        if self.values_ns == ():
            raise JobProblem("an empty list has nothing to draw from", ("values",))


class EmpiricalSpec(JobPart):
    """A table of quantiles with linear interpolation."""

    MEANT: ClassVar[str] = "values"
    MEANT_LIST: ClassVar[bool] = True

    values_ns: Annotated[tuple[int, ...], check(items(parse_short_time))] = Field(
        alias="values",
        description="The quantiles, from the least value to the greatest.",
        examples=[["1ms", "1.2ms", "4ms"]],
    )
    percent: Annotated[tuple[float, ...] | None, check(items(number(0, 100)), optional=True)] = (
        Field(
            default=None,
            description="Percentage of samples up to each value. Default: equally spaced.",
            examples=[[0, 90, 100]],
        )
    )

    @after_fields
    def _a_table(self) -> None:
        values, percent = self.values_ns, self.percent
        if len(values) < 2:
            raise JobProblem("a table needs two values at least, the least and the greatest")
        for index in range(1, len(values)):
            if values[index] < values[index - 1]:
                raise JobProblem("it is less than the one before", ("values", index))
        if percent is None:
            return
        if len(percent) != len(values):
            raise JobProblem(f"{len(values)} values need as many, got {len(percent)}", ("percent",))
        for index, expected in ((0, 0), (len(percent) - 1, 100)):
            if percent[index] != expected:
                raise JobProblem(
                    f"expected {expected}, of the {'greatest' if index else 'least'} value",
                    ("percent", index),
                )
        for index in range(1, len(percent)):
            if percent[index] <= percent[index - 1]:
                raise JobProblem("it is not more than the one before", ("percent", index))


def _check_point(value: object) -> tuple[int, int]:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise JobProblem("expected a pair: [time since the start, value]")
    return parse_time(value[0]), parse_short_time(value[1])


attach(_check_point, schema={"type": "array", "items": TIME_SCHEMA, "minItems": 2, "maxItems": 2})


class SeriesSpec(JobPart):
    """Values over time, in a list or a file."""

    OF_TIMES: ClassVar[tuple[str, ...]] = ("points",)
    ALTERNATIVES: ClassVar[tuple[tuple[str, ...], ...]] = (("points",), ("file", "unit"))
    MEANT: ClassVar[str] = "points"
    MEANT_LIST: ClassVar[bool] = True

    points: Annotated[
        tuple[tuple[int, int], ...] | None, check(items(_check_point), optional=True)
    ] = Field(
        default=None,
        description="Pairs of time since the start and value.",
        examples=[[["0s", "1ms"], ["60s", "20ms"]]],
    )
    file: Annotated[str | None, check(check_path, optional=True)] = Field(
        default=None,
        description="CSV file: time since the start, value.",
        examples=["link.csv"],
    )
    unit: Annotated[str, check(one_of(*SAMPLE_UNITS))] = Field(
        default="s", description="Unit of numbers without one.", examples=["s"]
    )
    steps: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Hold each value instead of interpolating.",
        examples=[True],
    )

    @after_fields
    def _one_source(self) -> None:
        if (self.points is None) == (self.file is None):
            raise JobProblem("give either points or a file")
        if self.points is not None:
            check_series(self.points)


def check_series(points: tuple[tuple[int, int], ...]) -> None:
    """Raise ``JobProblem`` unless there are points, in order of time."""
    if not points:
        raise JobProblem("a series needs at least one point", ("points",))
    for index in range(1, len(points)):
        if points[index][0] <= points[index - 1][0]:
            raise JobProblem("its time is not after that of the point before", ("points", index))


class DistributionSpec(JobPart):
    """A time: constant, random, or changing. Exactly one of the keys."""

    constant_ns: Annotated[int | None, check(parse_short_time, optional=True)] = Field(
        default=None, alias="constant", description="Constant.", examples=["5ms"]
    )
    uniform: Annotated[UniformSpec | None, given] = Field(
        default=None,
        description="Uniform, bounds included.",
        examples=[{"min": "1ms", "max": "3ms"}],
    )
    normal: Annotated[NormalSpec | None, given] = Field(
        default=None,
        description="Normal; negative values are drawn again.",
        examples=[{"mean": "5ms", "sd": "1ms"}],
    )
    lognormal: Annotated[LognormalSpec | None, given] = Field(
        default=None,
        description="Lognormal: a long tail.",
        examples=[{"median": "5ms", "sigma": 0.5}],
    )
    gamma: Annotated[GammaSpec | None, given] = Field(
        default=None, description="Gamma.", examples=[{"mean": "5ms", "sd": "2ms"}]
    )
    samples: Annotated[SamplesSpec | None, given] = Field(
        default=None,
        description="Random choice of measured values.",
        examples=[{"file": "delays.txt", "unit": "ms"}],
    )
    empirical: Annotated[EmpiricalSpec | None, given] = Field(
        default=None,
        description="Table of quantiles, from `rsltrace fit`.",
        examples=[{"values": ["1ms", "1.2ms", "4ms"], "percent": [0, 90, 100]}],
    )
    series: Annotated[SeriesSpec | None, given] = Field(
        default=None,
        description="Values over time.",
        examples=[{"points": [["0s", "1ms"], ["60s", "20ms"]]}],
    )

    KINDS: ClassVar[tuple[str, ...]] = (
        "constant",
        "uniform",
        "normal",
        "lognormal",
        "gamma",
        "samples",
        "empirical",
        "series",
    )
    ALTERNATIVES: ClassVar[tuple[tuple[str, ...], ...]] = tuple((kind,) for kind in KINDS)
    NEEDS_ONE: ClassVar[bool] = True

    @after_fields
    def _one_kind(self) -> None:
        given = self.kinds()
        if len(given) > 1:
            raise JobProblem(
                f"give one of {' and '.join(given)}, not both", (given[1],), at_key=True
            )
        if not given and self.NEEDS_ONE:
            raise JobProblem(f"give one of {', '.join(self.KINDS)}")

    def kinds(self) -> list[str]:
        """Return which of ``KINDS`` are given."""
        values = {**vars(self), "constant": self.constant_ns}
        return [kind for kind in self.KINDS if values[kind] is not None]
