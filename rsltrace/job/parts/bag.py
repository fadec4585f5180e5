"""One entry of ``bags:``: what plays, when, under which name and with which QoS."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart
from rsltrace.job.values.checks import (
    Globs,
    attach,
    check,
    check_names,
    number,
    one_of,
    positive_time,
    whole,
)
from rsltrace.job.values.mappings import check_path, names_to_names
from rsltrace.job.values.names import check_glob, check_topic
from rsltrace.job.values.problem import JobProblem, describe
from rsltrace.job.values.times import TimeLike, parse_time


class QosSpec(JobPart):
    """QoS that replaces the recorded one."""

    reliability: Annotated[
        Literal["reliable", "best_effort"] | None,
        check(one_of("reliable", "best_effort"), optional=True),
    ] = Field(default=None, description="Whether messages may be lost.", examples=["reliable"])
    durability: Annotated[
        Literal["volatile", "transient_local"] | None,
        check(one_of("volatile", "transient_local"), optional=True),
    ] = Field(
        default=None,
        description="Whether late subscriptions receive earlier messages.",
        examples=["transient_local"],
    )
    history: Annotated[
        Literal["keep_last", "keep_all"] | None,
        check(one_of("keep_last", "keep_all"), optional=True),
    ] = Field(default=None, description="Which earlier messages are kept.", examples=["keep_last"])
    depth: Annotated[int | None, check(whole(1, 2**31 - 1), optional=True)] = Field(
        default=None, description="Number of messages that `keep_last` keeps.", examples=[10]
    )

    def values(self) -> dict[str, str | int]:
        names = ("reliability", "durability", "history", "depth")
        return {name: value for name in names if (value := getattr(self, name)) is not None}


def _check_bag_remappings(value: object) -> dict[str, str]:
    return names_to_names(value, check_topic, check_topic)


_TOPIC = {"type": "string", "pattern": check_topic.pattern}  # type: ignore[attr-defined]
attach(
    _check_bag_remappings,
    schema={"type": "object", "propertyNames": _TOPIC, "additionalProperties": _TOPIC},
)


def _check_qos(value: object) -> object:
    if not isinstance(value, dict):
        raise JobProblem(f"expected a mapping of topics to QoS, got {describe(value)}")
    check_names(value, check_glob)
    return value


def _check_loop(value: object) -> bool | int:
    if isinstance(value, bool):
        return value
    if not isinstance(value, int):
        raise JobProblem(f"expected true, false or how often it plays, got {describe(value)}")
    return whole(1)(value)


attach(_check_loop, schema={"anyOf": [{"type": "boolean"}, {"type": "integer", "minimum": 1}]})


def _not_empty_in_a_file(value: object, in_file: bool) -> object:
    if not value and in_file:
        raise JobProblem("an empty list would play nothing: leave the key out to play all topics")
    return value


class BagSpec(JobPart):
    """One entry of ``bags:``.

    ``topics`` and ``exclude`` are globs in which ``*`` matches ``/`` too; no ``topics`` means all.
    ``start_offset_ns`` counts from the first message of the whole bag, ``duration_ns`` from there.
    """

    path: Annotated[str, check(check_path)] = Field(
        description="The folder, `.mcap` or `.db3` file.",
        examples=["../bags/outdoor"],
    )
    topics: Annotated[Globs, _not_empty_in_a_file] = Field(
        default=(),
        description="Topics to play, as globs. Default: all.",
        examples=[["/imu/*", "/odom"]],
    )
    exclude: Globs = Field(
        default=(), description="Topics not to play, as globs.", examples=[["/tf", "/camera/*"]]
    )
    start_offset_ns: Annotated[int, check(parse_time)] = Field(
        default=0,
        alias="start_offset",
        description="Skip this much from the first message on.",
        examples=["5s"],
    )
    duration_ns: Annotated[int | None, check(positive_time, optional=True)] = Field(
        default=None,
        alias="duration",
        description="Play only this much recorded time.",
        examples=["30s"],
    )
    at_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="at",
        description="Simulated time of the first message. Default: the recorded time. "
        "Header stamps stay.",
        examples=["0s"],
    )
    rate: Annotated[float, check(number(0, open_below=True))] = Field(
        default=1.0,
        description="Speed factor.",
        examples=[0.5],
    )
    loop: Annotated[bool | int, check(_check_loop)] = Field(
        default=False,
        description="Number of passes; `true`: forever, needs a `stop`.",
        examples=[True, 3],
    )
    by: Annotated[
        Literal["log_time", "publish_time", "header_stamp"],
        check(one_of("log_time", "publish_time", "header_stamp")),
    ] = Field(
        default="log_time",
        description="When a message plays: log time, publish time (MCAP only), or header "
        "stamp (else log time).",
        examples=["header_stamp"],
    )
    remappings: Annotated[dict[str, str], check(_check_bag_remappings)] = Field(
        default_factory=dict,
        description="Topics that play under another name.",
        examples=[{"/scan": "/lidar/scan"}],
    )
    qos: Annotated[dict[str, QosSpec], check(_check_qos)] = Field(
        default_factory=dict,
        description="QoS by topic glob, replacing the recorded one. The first match counts.",
        examples=[{"/map": {"durability": "transient_local", "depth": 1}}],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            path: str | os.PathLike[str],
            topics: Sequence[str] = (),
            exclude: Sequence[str] = (),
            start_offset: TimeLike = 0,
            start_offset_ns: int = 0,
            duration: TimeLike | None = None,
            duration_ns: int | None = None,
            at: TimeLike | None = None,
            at_ns: int | None = None,
            rate: float = 1.0,
            loop: bool | int = False,
            by: Literal["log_time", "publish_time", "header_stamp"] = "log_time",
            remappings: dict[str, str] = ...,
            qos: dict[str, QosSpec | dict[str, Any]] = ...,
        ) -> None: ...
