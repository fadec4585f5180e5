"""``latency:`` of a check: how long data may take through a chain of topics."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import Field, model_validator

from rsltrace.job.parts.part import Part
from rsltrace.job.values.checks import check, items, number, one_of, positive_time, text
from rsltrace.job.values.names import check_node_glob, check_topic
from rsltrace.job.values.problem import Problem

MEASURES = ("latency", "age", "last_age", "reaction", "worst_reaction")

Topic = Annotated[str | None, check(text(check_topic), optional=True)]


class LatencySpec(Part):
    """What data takes through a chain stays below a time. The chain is given by ``start`` (in a
    file: ``from``) and ``end`` (``to``), or by all of its topics (``chain``)."""

    TIMES: ClassVar[dict[str, str]] = {"below": "below_ns"}

    start: Topic = Field(
        default=None,
        alias="from",
        description="The topic of the inputs.",
        examples=["/scan"],
    )
    end: Topic = Field(
        default=None,
        alias="to",
        description="The topic of the outputs, or the node whose callback is the end.",
        examples=["/cmd_vel"],
    )
    chain: Annotated[tuple[str, ...], check(items(text(check_topic)))] = Field(
        default=(),
        description="All topics of the chain, instead of `from` and `to`.",
        examples=[["/scan", "/objects", "/cmd_vel"]],
    )
    via: Annotated[tuple[str, ...], check(items(text(check_node_glob)))] = Field(
        default=(),
        description="Nodes (globs) that make use of the last message that they received, as a "
        "timer does that samples.",
        examples=[["/controller"]],
    )
    measure: Annotated[str, check(one_of(*MEASURES))] = Field(
        default="latency",
        description="What has to be below: the `latency`, the `age` of data (`last_age`: until the "
        "next output), the `reaction` to an input (`worst_reaction`: to what happens right after "
        "the input before), as `docs/latency.md` defines them.",
        examples=["age"],
    )
    below_ns: Annotated[int, check(positive_time)] = Field(
        alias="below", description="What all of them have to be below.", examples=["50ms"]
    )
    quantile: Annotated[float | None, check(number(0, 100, open_below=True), optional=True)] = (
        Field(
            default=None,
            description="Percentage of them that has to be; without it, all.",
            examples=[99],
        )
    )

    @model_validator(mode="after")
    def _says_which_chain(self) -> LatencySpec:
        if self.chain and (self.start is not None or self.end is not None):
            raise Problem("give either chain, or from and to", ("chain",))
        if not self.chain and (self.start is None or self.end is None):
            raise Problem("which chain? Give from and to, or chain")
        if self.chain and len(self.chain) < 2:
            raise Problem("a chain has two topics at least", ("chain",))
        if self.start is not None and self.start == self.end:
            raise Problem("from and to are the same topic; give a loop as a chain", ("to",))
        return self

    @property
    def wanted(self) -> dict[str, Any]:
        """The chain, as ``measure_latencies`` takes it."""
        return {"start": self.start, "end": self.end, "topics": self.chain, "via": self.via}
