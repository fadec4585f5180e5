"""``checks:`` of a job: what has to be true of a run, found out from its trace."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import (
    Target,
    attach,
    check,
    check_callable_target,
    given,
    items,
    number,
    one_of,
    positive_time,
    text,
)
from rsltrace.job.values.names import check_node_glob, check_topic
from rsltrace.job.values.problem import JobProblem, describe
from rsltrace.job.values.times import TimeLike

# ``latency:`` of a check: how long data may take through a chain of topics.

MEASURES = ("latency", "age", "last_age", "reaction", "worst_reaction")

Topic = Annotated[str | None, check(text(check_topic), optional=True)]


class LatencySpec(JobPart):
    """A limit of an end-to-end latency. Give ``from`` and ``to``, or all topics of the chain."""

    start: Topic = Field(
        default=None,
        alias="from",
        description="First topic of the chain.",
        examples=["/scan"],
    )
    end: Topic = Field(
        default=None,
        alias="to",
        description="Last topic of the chain, or a node.",
        examples=["/cmd_vel"],
    )
    chain: Annotated[tuple[str, ...], check(items(text(check_topic)))] = Field(
        default=(),
        description="All topics, instead of `from` and `to`.",
        examples=[["/scan", "/objects", "/cmd_vel"]],
    )
    via: Annotated[tuple[str, ...], check(items(text(check_node_glob)))] = Field(
        default=(),
        description="Nodes (globs) that sample, as `--via` of `rsltrace latency`.",
        examples=[["/controller"]],
    )
    measure: Annotated[str, check(one_of(*MEASURES))] = Field(
        default="latency",
        description="What to measure, defined in `docs/latency.md`.",
        examples=["age"],
    )
    below_ns: Annotated[int, check(positive_time)] = Field(
        alias="below", description="The upper limit.", examples=["50ms"]
    )
    quantile: Annotated[float | None, check(number(0, 100, open_below=True), optional=True)] = (
        Field(
            default=None,
            description="Percentage that has to meet the limit. Default: all.",
            examples=[99],
        )
    )

    @after_fields
    def _says_which_chain(self) -> None:
        if self.chain and (self.start is not None or self.end is not None):
            raise JobProblem("give either chain, or from and to", ("chain",))
        if not self.chain and (self.start is None or self.end is None):
            raise JobProblem("which chain? Give from and to, or chain")
        if self.chain and len(self.chain) < 2:
            raise JobProblem("a chain has two topics at least", ("chain",))
        if self.start is not None and self.start == self.end:
            raise JobProblem("from and to are the same topic; give a loop as a chain", ("to",))

    @property
    def wanted(self) -> dict[str, Any]:
        """The chain, as ``measure_latencies`` takes it."""
        return {"start": self.start, "end": self.end, "topics": self.chain, "via": self.via}


# ``metrics:`` of a job: numbers that say how a run went, found out from its trace.


class MetricSpec(JobPart):
    """One number. Exactly one of ``expression`` and ``function``; a text alone is an
    ``expression``."""

    ONE_OF: ClassVar[tuple[str, ...]] = ("expression", "function")

    expression: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None,
        description="Expression over the finished run, as in `rsltrace bisect --check`.",
        examples=['last("/odom").pose.pose.position.x'],
    )
    function: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="Function of the finished `rsltrace.Trace` that returns the number or `None`.",
        examples=["my_robot.metrics:energy"],
    )
    unit: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None, description="Unit, for reports.", examples=["m"]
    )

    @after_fields
    def _says_one_thing(self) -> None:
        if (self.expression is None) == (self.function is None):
            raise JobProblem("give expression or function")


_RATE = re.compile(r"\s*(\S+?)\s*[Hh][Zz]\s*")
_positive = number(0, open_below=True)


def _rate(value: object) -> float:
    found = _RATE.fullmatch(value) if isinstance(value, str) else None
    if found is None:
        if isinstance(value, str):
            raise JobProblem(f"expected a rate (9 Hz), got {describe(value)}")
        return float(_positive(value))
    try:
        return float(_positive(float(found[1])))
    except ValueError:
        raise JobProblem(f"expected a rate above 0 (9 Hz), got {describe(value)}") from None


attach(
    _rate,
    schema={
        "anyOf": [
            {"type": "number", "exclusiveMinimum": 0},
            {"type": "string", "pattern": r"^\s*[0-9.eE+-]+\s*[Hh][Zz]\s*$"},
        ]
    },
)

Condition = Annotated[str | None, check(text(), optional=True)]


class CheckSpec(JobPart):
    """One property of the run. Exactly one of ``always``, ``never``,
    ``eventually``, ``rate``, ``latency`` and ``function``."""

    KINDS: ClassVar[tuple[str, ...]] = (
        "always",
        "never",
        "eventually",
        "rate",
        "latency",
        "function",
    )

    name: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None,
        description="Name of the check in reports.",
        examples=["stays on the map"],
    )
    always: Condition = Field(
        default=None,
        description="Must be true of every message.",
        examples=["/odom.pose.pose.position.x < 10", "/scan: min(ranges) > 0.1"],
    )
    never: Condition = Field(
        default=None,
        description="Must not happen: a message, a log record, an exception, a finding.",
        examples=["/cmd_vel.linear.x > 1.5", "log error"],
    )
    eventually: Condition = Field(
        default=None,
        description="Must happen `within` a time of the start, or of each `after`.",
        examples=["/goal_reached.data"],
    )
    rate: Annotated[str | None, check(text(check_topic), optional=True)] = Field(
        default=None,
        description="Topic whose rate must be `at_least` or `at_most` a value.",
        examples=["/scan"],
    )
    latency: Annotated[LatencySpec | None, given] = Field(
        default=None,
        description="Limit of an end-to-end latency.",
        examples=[{"from": "/scan", "to": "/cmd_vel", "below": "50ms", "quantile": 99}],
    )
    function: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="Function of the finished `rsltrace.Trace`: see `docs/checks.md`.",
        examples=["my_robot.checks:no_collision"],
    )
    after: Condition = Field(
        default=None,
        description="The check applies after each time that this happens.",
        examples=["/stop", "/scan: min(ranges) < 0.3"],
    )
    within_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None,
        alias="within",
        description="How long the check applies after that or the start.",
        examples=["200ms"],
    )
    at_least: Annotated[float | None, check(_rate, optional=True)] = Field(
        default=None, description="The lowest rate, in Hz.", examples=["9 Hz", 9]
    )
    at_most: Annotated[float | None, check(_rate, optional=True)] = Field(
        default=None, description="The highest rate, in Hz.", examples=["11 Hz"]
    )
    over_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None,
        alias="over",
        description="Window in which messages are counted. Default: one second.",
        examples=["500ms"],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            name: str | None = None,
            always: str | None = None,
            never: str | None = None,
            eventually: str | None = None,
            rate: str | None = None,
            latency: LatencySpec | dict[str, Any] | None = None,
            function: Target | None = None,
            after: str | None = None,
            within: TimeLike | None = None,
            within_ns: int | None = None,
            at_least: float | str | None = None,
            at_most: float | str | None = None,
            over: TimeLike | None = None,
            over_ns: int | None = None,
        ) -> None: ...

    @property
    def kind(self) -> str:
        return next(kind for kind in self.KINDS if getattr(self, kind) is not None)

    @after_fields
    def _says_one_thing(self) -> None:
        kind = self._only(self.KINDS)
        if kind == "rate" and self.at_least is None and self.at_most is None:
            raise JobProblem("how often? Give at_least or at_most (9 Hz)", ("rate",))
        for keys, kinds in (
            (("after", "within_ns"), ("always", "never", "eventually")),
            (("at_least", "at_most", "over_ns"), ("rate",)),
        ):
            for key in keys:
                if getattr(self, key) is not None and kind not in kinds:
                    named = key.removesuffix("_ns")
                    raise JobProblem(f"{named} is for {', '.join(kinds)}, not for {kind}", (named,))
