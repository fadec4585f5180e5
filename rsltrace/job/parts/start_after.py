"""``start_after:`` of an entry: it starts later than the run does, as a launch file's timers and
event handlers would have it."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from rsltrace.job.parts.part import Part
from rsltrace.job.values.checks import attach, check, text
from rsltrace.job.values.names import check_topic
from rsltrace.job.values.problem import Problem, describe
from rsltrace.job.values.times import parse_time


def _check_entry(value: object) -> str | int:
    """Check what names an entry of ``nodes:``: text, or its number in the list."""
    if isinstance(value, bool) or not isinstance(value, (str, int)) or value == "":
        raise Problem(
            "expected an entry of nodes: its name, what it runs, or its number in the list "
            f"(from 0), got {describe(value)}"
        )
    if isinstance(value, int):
        if value < 0:
            raise Problem(f"entries of nodes are counted from 0, got {value}")
        return int(value)
    return str(value)


attach(_check_entry, schema={"anyOf": [{"type": "string"}, {"type": "integer", "minimum": 0}]})

FullName = Annotated[str | None, check(text(check_topic), optional=True)]
EntryName = Annotated[str | int | None, check(_check_entry, optional=True)]


class StartAfterSpec(Part):
    """When an entry starts: once all that is given has come true, and ``delay`` later. A plain
    time stands for ``{delay: time}``. The name of an entry is its ``name``, what it runs
    (``package/name``, ``module:main``), or its number in the list."""

    MEANT: ClassVar[str] = "delay"
    TIMES: ClassVar[dict[str, str]] = {"delay": "delay_ns"}
    CONDITIONS: ClassVar[tuple[str, ...]] = ("topic", "service", "node", "started", "ended")

    delay_ns: Annotated[int, check(parse_time)] = Field(
        default=0,
        alias="delay",
        description="This much later: after the start of the run, or after the last of the other "
        "conditions has come true.",
        examples=["2s"],
    )
    topic: FullName = Field(
        default=None,
        description="After the first message on this topic.",
        examples=["/map"],
    )
    service: FullName = Field(
        default=None,
        description="After this service has got a server.",
        examples=["/set_mode"],
    )
    node: FullName = Field(
        default=None, description="After this node has been made.", examples=["/robot/driver"]
    )
    started: EntryName = Field(
        default=None,
        description="After another entry has started: its constructor is done, or its main waits "
        "or spins for the first time.",
        examples=["driver", 0],
    )
    ended: EntryName = Field(
        default=None,
        description="After another entry has ended: a `main`, `executable`, `script` or `module`.",
        examples=["my_robot/calibrate", 0],
    )

    @classmethod
    def after(cls, delay_ns: int) -> StartAfterSpec:
        """Return the rule of an entry that starts ``delay_ns`` after the run."""
        return cls(delay=f"{delay_ns}ns")  # type: ignore[arg-type]

    @model_validator(mode="after")
    def _says_something(self) -> StartAfterSpec:
        if not self.model_fields_set:
            raise Problem(f"give one of delay, {', '.join(self.CONDITIONS)}")
        return self
