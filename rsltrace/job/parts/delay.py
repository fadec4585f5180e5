"""``delay:`` of a job: how long messages take, which are lost, and who is cut off when."""

from __future__ import annotations

from typing import Annotated, ClassVar

from rsltrace.job.parts.distribution import DistributionSpec
from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import (
    check,
    flag,
    given,
    named_parts,
    number,
    part,
    parts,
    positive_time,
    text,
)
from rsltrace.job.values.mappings import check_path
from rsltrace.job.values.names import check_glob, check_node_glob, check_service_glob
from rsltrace.job.values.problem import JobProblem
from rsltrace.job.values.times import parse_time

Probability = Annotated[float, check(number(0, 1))]


class BurstSpec(JobPart):
    """Loss in bursts, after Gilbert and Elliott: a good and a bad state, probabilities per message.

    A burst lasts 1 / ``bad_to_good`` messages on average.
    """

    good_to_bad: Probability = Field(
        description="Probability that a burst begins with a message.", examples=[0.01]
    )
    bad_to_good: Probability = Field(
        description="Probability that a burst ends with a message.", examples=[0.2]
    )
    loss_bad: Probability = Field(
        default=1.0, description="Probability of a loss in a burst.", examples=[0.9]
    )
    loss_good: Probability = Field(
        default=0.0, description="Probability of a loss outside of bursts.", examples=[0.001]
    )


class DelaySpec(DistributionSpec):
    """Delay and loss of messages. A plain time stands for ``{constant: time}``."""

    NEEDS_ONE: ClassVar[bool] = False

    drop: Probability = Field(
        default=0.0,
        description="Probability of loss. Reliable messages are late by `retransmit`.",
        examples=[0.01],
    )
    burst: Annotated[BurstSpec | None, given] = Field(
        default=None,
        description="Loss in bursts (Gilbert-Elliott).",
        examples=[{"good_to_bad": 0.01, "bad_to_good": 0.2}],
    )
    duplicate: Probability = Field(
        default=0.0,
        description="Probability that a message arrives twice.",
        examples=[0.001],
    )
    keep_order: Annotated[bool, check(flag)] = Field(
        default=True,
        description="Whether messages of a link stay in order.",
        examples=[False],
    )
    retransmit_ns: Annotated[int, check(positive_time)] = Field(
        default=10_000_000,
        alias="retransmit",
        description="Extra delay of a reliable message for each loss.",
        examples=["10ms"],
    )


class LinkSpec(DelaySpec):
    """Delay from some publishers to some subscriptions."""

    topic: Annotated[str, check(text(check_glob))] = Field(
        default="*", description="Topic, a glob.", examples=["/scan"]
    )
    sender: Annotated[str, check(text(check_node_glob))] = Field(
        default="*",
        alias="from",
        description="Node of the publisher, a glob.",
        examples=["/lidar"],
    )
    receiver: Annotated[str, check(text(check_node_glob))] = Field(
        default="*", alias="to", description="Node of the subscription, a glob.", examples=["/slam"]
    )


class OutageSpec(JobPart):
    """A topic, service or node is cut off for some time."""

    topic: Annotated[str | None, check(text(check_glob), optional=True)] = Field(
        default=None, description="Topic that is cut off, a glob.", examples=["/scan"]
    )
    service: Annotated[str | None, check(text(check_service_glob), optional=True)] = Field(
        default=None, description="Service that is cut off, a glob.", examples=["/set_mode"]
    )
    node: Annotated[str | None, check(text(check_node_glob), optional=True)] = Field(
        default=None, description="Node that is cut off, a glob.", examples=["/lidar"]
    )
    from_ns: Annotated[int, check(parse_time)] = Field(
        alias="from", description="Begin, since the start.", examples=["10s"]
    )
    to_ns: Annotated[int, check(parse_time)] = Field(
        alias="to", description="End, since the start.", examples=["12s"]
    )

    @after_fields
    def _one_thing(self) -> None:
        if sum(name is not None for name in (self.topic, self.service, self.node)) != 1:
            raise JobProblem("give one of topic, service or node")
        if self.to_ns < self.from_ns:
            raise JobProblem("the outage ends before it begins", ("to",))
        if self.to_ns == self.from_ns:
            raise JobProblem("the outage ends when it begins: 'to' has to be later", ("to",))

    @property
    def what(self) -> tuple[str, str]:
        """What is cut off: its kind, and its glob."""
        for kind in ("topic", "service", "node"):
            glob = getattr(self, kind)
            if glob is not None:
                return kind, glob
        raise AssertionError("checked when it was made")


class DelaysSpec(JobPart):
    """Delays and losses: the first match among ``links``, ``topics`` (exact names before globs),
    ``file`` and ``default``."""

    MEANT: ClassVar[str] = "default"

    default: Annotated[DelaySpec | None, part("constant")] = Field(
        default=None,
        description="Default for topics (except /rosout and /parameter_events) and services.",
        examples=["1ms"],
    )
    topics: Annotated[dict[str, DelaySpec], named_parts("constant", check_glob)] = Field(
        default_factory=dict,
        description="By topic glob.",
        examples=[{"/scan": {"constant": "5ms"}}],
    )
    links: Annotated[tuple[LinkSpec, ...], parts()] = Field(
        default=(),
        description="Between certain publishers and subscriptions.",
        examples=[[{"topic": "/scan", "to": "/slam", "constant": "20ms"}]],
    )
    services: Annotated[dict[str, DelaySpec], named_parts("constant", check_service_glob)] = Field(
        default_factory=dict,
        description="By service glob, for requests and responses.",
        examples=[{"/set_mode": "2ms"}],
    )
    outages: Annotated[tuple[OutageSpec, ...], parts()] = Field(
        default=(),
        description="Outages. Best-effort messages are lost; reliable ones wait.",
        examples=[[{"node": "/lidar", "from": "10s", "to": "12s"}]],
    )
    file: Annotated[str | None, check(check_path, optional=True)] = Field(
        default=None,
        description="Delay file of RSLCPP (CSV) with FIXED delays.",
        examples=["delays.csv"],
    )

    @after_fields
    def _answered_once(self) -> None:
        for name, model in self.services.items():
            if model.duplicate:
                place = ("services", name, "duplicate")
                raise JobProblem("requests and responses of services never arrive twice", place)
