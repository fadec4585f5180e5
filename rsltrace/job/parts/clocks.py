"""``clocks:`` of a job: the clocks of some nodes are wrong, as real ones are."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import Annotated, ClassVar, Literal

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import (
    attach,
    check,
    flag,
    given,
    one_of,
    parts,
    positive_time,
    text,
)
from rsltrace.job.values.names import check_node_glob
from rsltrace.job.values.problem import JobProblem, describe
from rsltrace.job.values.times import TIME_SCHEMA, ExactFloat, Nanoseconds, parse_time

DRIFT_MAX_PPM = 100_000
JUMPS_EVERY_NS_MIN = 1_000_000


def parse_signed_time(value: object) -> int:
    """Return a time that may be negative, in nanoseconds."""
    if isinstance(value, Nanoseconds):
        if isinstance(value.value, int) and not isinstance(value.value, bool):
            return value.value
    elif isinstance(value, str) and re.match(r"\s*-\s*[^-+]", value):
        return -parse_time(value.strip()[1:])
    elif isinstance(value, (int, float)) and not isinstance(value, bool) and value < 0:
        if isinstance(value, ExactFloat):
            return -parse_time(f"{value.text.strip().lstrip('-')}s")
        return -parse_time(-value)
    return parse_time(value)


def parse_interval(value: object) -> int:
    """Return a mean time between jumps: each jump of a run is drawn and kept."""
    time_ns = parse_time(value)
    if time_ns < JUMPS_EVERY_NS_MIN:
        raise JobProblem("must be at least 1ms")
    return time_ns


def parse_ppm(value: object) -> float:
    """Return a drift in parts per million: a number, or text such as ``50ppm``."""
    bare = value.strip().removesuffix("ppm") if isinstance(value, str) else value
    try:
        if isinstance(bare, bool) or not isinstance(bare, (str, int, float)):
            raise ValueError
        ppm = float(bare)
    except ValueError:
        raise JobProblem(
            f"expected parts per million such as 50ppm, got {describe(value)}"
        ) from None
    if not -DRIFT_MAX_PPM <= ppm <= DRIFT_MAX_PPM:
        raise JobProblem(f"must be between -{DRIFT_MAX_PPM} and {DRIFT_MAX_PPM} ppm, got {bare}")
    return ppm


_signed = {
    "anyOf": [{"type": "number"}, {"type": "string", "pattern": r"^\s*-?"}],
}
attach(parse_signed_time, schema=_signed)
attach(parse_interval, schema=TIME_SCHEMA)
attach(parse_ppm, schema={"anyOf": [{"type": "number"}, {"type": "string", "pattern": "ppm\\s*$"}]})


class JumpSpec(JobPart):
    """A jump of a clock."""

    LISTED: ClassVar[tuple[str, ...]] = ("at", "by")

    at_ns: Annotated[int, check(parse_time)] = Field(
        alias="at", description="Time since the start.", examples=["5s"]
    )
    by_ns: Annotated[int, check(parse_signed_time)] = Field(
        alias="by", description="Size; negative is backwards.", examples=["100ms", "-1s"]
    )


class RandomJumpsSpec(JobPart):
    """Jumps at random times (a Poisson process) of random size (uniform), from the job's seed."""

    every_ns: Annotated[int, check(parse_interval)] = Field(
        alias="every", description="Mean time between two jumps.", examples=["10s"]
    )
    most_ns: Annotated[int, check(positive_time)] = Field(
        alias="most", description="Largest size, in either direction.", examples=["50ms"]
    )


class ClockSpec(JobPart):
    """How the clock of some nodes differs from simulated time."""

    node: Annotated[str, check(text(check_node_glob))] = Field(
        default="*",
        description="Node glob. The first match counts.",
        examples=["/lidar"],
    )
    advances: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Whether each reading of a ROS clock advances it by a nanosecond. "
        "Default: it stands still during a callback.",
        examples=[True],
    )
    source: Annotated[Literal["run", "topic"], check(one_of("run", "topic"))] = Field(
        default="run",
        description="What drives ROS time with `use_sim_time`: the `run`, or the `topic` /clock.",
        examples=["topic"],
    )
    offset_ns: Annotated[int, check(parse_signed_time)] = Field(
        default=0,
        alias="offset",
        description="How far it is ahead of simulated time.",
        examples=["-20ms"],
    )
    drift_ppm: Annotated[float, check(parse_ppm)] = Field(
        default=0.0,
        alias="drift",
        description="Drift in parts per million since the start.",
        examples=["50ppm"],
    )
    jumps: Annotated[tuple[JumpSpec, ...], parts()] = Field(
        default=(),
        description="When it jumps; by a negative time: backwards.",
        examples=[[{"at": "5s", "by": "100ms"}]],
    )
    random_jumps: Annotated[RandomJumpsSpec | None, given] = Field(
        default=None,
        description="Jumps at random times (Poisson) of random size (uniform, either way).",
        examples=[{"every": "10s", "most": "50ms"}],
    )

    @after_fields
    def _jumps_in_order(self) -> None:
        for index in range(1, len(self.jumps)):
            if self.jumps[index].at_ns < self.jumps[index - 1].at_ns:
                raise JobProblem("it is before the jump above", ("jumps", index, "at"))

    def drift(self) -> Fraction:
        """The drift as an exact fraction."""
        return Fraction(self.drift_ppm) / 1_000_000
