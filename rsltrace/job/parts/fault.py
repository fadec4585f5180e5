"""``faults:`` of a job: what goes wrong in a run, and exactly when."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import check, number, text, whole
from rsltrace.job.values.names import check_node_glob, check_topic
from rsltrace.job.values.problem import JobProblem, describe
from rsltrace.job.values.times import TimeLike, parse_time

# A field within a message, as a job names it, and what a job may put there.


Step = tuple[str, "int | str | None"]
"""The name of a field, and which of its items: a number, ``*`` for all, None for it as a whole."""

_STEP = re.compile(r"([A-Za-z][A-Za-z0-9_]*)(?:\[(-?[0-9]{1,9}|\*)\])?", re.ASCII)
_WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def check_field(text: str) -> None:
    """Raise ValueError unless ``text`` names a field: ``pose.position.x``, ``ranges[3]``."""
    field_steps(text)


def field_steps(text: str) -> tuple[Step, ...]:
    """Return the way to a field, step by step.

    :raises ValueError: it names none.
    """
    steps: list[Step] = []
    for part in text.split("."):
        found = _STEP.fullmatch(part)
        if found is None:
            raise ValueError(
                f"{text!r} is not a field: write pose.position.x, ranges[3], ranges[-1] for the "
                "last or ranges[*] for all"
            )
        name, item = found.groups()
        steps.append((name, item if item in (None, "*") else int(item)))
    return tuple(steps)


def field_value(value: Any) -> Any:
    """Return a value for a field as a job keeps it. What JSON has no number for is a word.

    :raises ValueError: it is neither text, number, truth value nor a list of these.
    """
    if isinstance(value, (list, tuple)):
        return [_single(item) for item in value]
    return _single(value)


def _single(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    raise ValueError(f"expected text, a number, true or false, or a list, got {describe(value)}")


def number_of(value: Any) -> float | int | None:
    """Return the number that a value for a field is, None if it is none."""
    if isinstance(value, str):
        return _WORDS.get(value)
    return None if isinstance(value, bool) or not isinstance(value, (int, float)) else value


_HUGE = 1.7976931348623157e308
FullName = Annotated[str | None, check(text(check_topic), optional=True)]


class FaultSpec(JobPart):
    """One fault. Exactly one of ``crash``, ``hang`` and ``restart`` (a node, and
    when: ``at``, ``event``, or ``message`` of a ``topic``), of ``drop``, ``duplicate`` and
    ``delay`` (a topic, and which ``message``), or of ``change``, ``swap`` and ``repeat`` (a topic
    that bags play, and which ``message`` of theirs)."""

    OF_NODES: ClassVar[tuple[str, ...]] = ("crash", "hang", "restart")
    OF_MESSAGES: ClassVar[tuple[str, ...]] = ("drop", "duplicate", "delay")
    OF_BAGS: ClassVar[tuple[str, ...]] = ("change", "swap", "repeat")
    CHANGES: ClassVar[tuple[str, ...]] = ("value", "scale", "offset", "length")
    ONE_OF: ClassVar[tuple[str, ...]] = OF_NODES + OF_MESSAGES + OF_BAGS

    crash: FullName = Field(
        default=None,
        description="Node that ends at once, without `finally` blocks.",
        examples=["/planner"],
    )
    hang: FullName = Field(
        default=None,
        description="Node that does nothing `for` some time or to the end.",
        examples=["/planner"],
    )
    restart: FullName = Field(
        default=None,
        description="Node that crashes and starts again, at once or after `for`.",
        examples=["/planner"],
    )
    drop: FullName = Field(
        default=None,
        description="Topic of a lost message.",
        examples=["/scan"],
    )
    duplicate: FullName = Field(
        default=None,
        description="Topic of a message that arrives again after `by`.",
        examples=["/scan"],
    )
    delay: FullName = Field(
        default=None,
        description="Topic of a message that is late `by` some time.",
        examples=["/scan"],
    )
    change: FullName = Field(
        default=None,
        description="Topic of a bag; `field` of a message changes.",
        examples=["/scan"],
    )
    swap: FullName = Field(
        default=None,
        description="Topic of a bag; a message and the next one change places.",
        examples=["/odom"],
    )
    repeat: FullName = Field(
        default=None,
        description="Topic of a bag; a message repeats the one before.",
        examples=["/odom"],
    )
    at_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="at",
        description="Time of a node's fault, since the start.",
        examples=["2s"],
    )
    event: Annotated[int | None, check(whole(0), optional=True)] = Field(
        default=None,
        description="Event after which it happens to a node.",
        examples=[1280],
    )
    topic: FullName = Field(
        default=None,
        description="Topic after whose `message` it happens to a node.",
        examples=["/goal"],
    )
    message: Annotated[int | None, check(whole(1), optional=True)] = Field(
        default=None,
        description="Which message of the topic, from 1.",
        examples=[3],
    )
    for_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="for",
        description="How long a node hangs or is gone.",
        examples=["500ms"],
    )
    by_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="by",
        description="Delay of the message or its copy.",
        examples=["200ms"],
    )
    to: Annotated[str | None, check(text(check_node_glob), optional=True)] = Field(
        default=None,
        description="Receivers it happens to, a glob. Default: all.",
        examples=["/slam"],
    )

    field: Annotated[str | None, check(text(check_field), optional=True)] = Field(
        default=None,
        description="The field to change; `[-1]` is the last item, `[*]` all.",
        examples=["ranges[3]"],
    )
    value: Annotated[Any, check(field_value, optional=True)] = Field(
        default=None,
        description="New value; `nan`, `inf` and `-inf` are numbers.",
        examples=["nan"],
    )
    scale: Annotated[float | None, check(number(-_HUGE, _HUGE), optional=True)] = Field(
        default=None,
        description="Factor.",
        examples=[-1],
    )
    offset: Annotated[float | None, check(number(-_HUGE, _HUGE), optional=True)] = Field(
        default=None,
        description="Summand.",
        examples=[0.5],
    )
    length: Annotated[int | None, check(whole(0), optional=True)] = Field(
        default=None,
        description="New length of the array; the last item may repeat.",
        examples=[0],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            crash: str | None = None,
            hang: str | None = None,
            restart: str | None = None,
            drop: str | None = None,
            duplicate: str | None = None,
            delay: str | None = None,
            at: TimeLike | None = None,
            at_ns: int | None = None,
            event: int | None = None,
            topic: str | None = None,
            message: int | None = None,
            for_ns: int | None = None,
            by: TimeLike | None = None,
            by_ns: int | None = None,
            to: str | None = None,
            change: str | None = None,
            swap: str | None = None,
            repeat: str | None = None,
            field: str | None = None,
            value: Any = None,
            scale: float | None = None,
            offset: float | None = None,
            length: int | None = None,
        ) -> None: ...

    @property
    def kind(self) -> str:
        return next(kind for kind in self.ONE_OF if getattr(self, kind) is not None)

    @property
    def name(self) -> str:
        """The node or topic that it is about."""
        return str(getattr(self, self.kind))

    @property
    def of_node(self) -> bool:
        return self.kind in self.OF_NODES

    @property
    def of_message(self) -> bool:
        """Whether it is about a message on its way to its receivers."""
        return self.kind in self.OF_MESSAGES

    @property
    def of_bag(self) -> bool:
        """Whether it is about a message that bags play, before it is published."""
        return self.kind in self.OF_BAGS

    @after_fields
    def _says_one_thing(self) -> None:
        self._only(self.ONE_OF)
        for key, field, kinds in (
            ("at", self.at_ns, self.OF_NODES),
            ("event", self.event, self.OF_NODES),
            ("topic", self.topic, self.OF_NODES),
            ("for", self.for_ns, ("hang", "restart")),
            ("by", self.by_ns, ("duplicate", "delay")),
            ("to", self.to, self.OF_MESSAGES),
            *((key, getattr(self, key), ("change",)) for key in ("field", *self.CHANGES)),
        ):
            if field is not None and self.kind not in kinds:
                raise JobProblem(f"{key} is for {' and '.join(kinds)}, not for {self.kind}", (key,))
        self._says_when()
        self._says_what()
        if self.hang is not None and self.for_ns == 0:
            raise JobProblem(
                "must be more than 0; without it the node hangs up to the end", ("for",)
            )
        if self.delay is not None and not self.by_ns:
            raise JobProblem("how late is the message? Give by: 200ms", ("delay",))

    def _says_what(self) -> None:
        if self.repeat is not None and self.message == 1:
            raise JobProblem("there is no message before the first one", ("message",))
        if self.change is None:
            return
        if self.field is None:
            raise JobProblem(f"what changes? Give field: a field of {self.change}", ("change",))
        self._only(self.CHANGES, ("field",))

    def _says_when(self) -> None:
        if not self.of_node:
            if self.message is None:
                raise JobProblem(f"which message of {self.name}? Give message: 3", (self.kind,))
            return
        given = [key for key in ("at_ns", "event", "topic") if getattr(self, key) is not None]
        if len(given) > 1:
            names = " and ".join(key.removesuffix("_ns") for key in given)
            raise JobProblem(f"{names} are given: say only once when it happens", (self.kind,))
        if (self.topic is None) != (self.message is None):
            missing = "message: 3" if self.message is None else "topic: /goal"
            raise JobProblem(f"topic and message go together: give {missing}", (self.kind,))
        if not given:
            raise JobProblem(
                "when? Give at: 2s, event: 1280, or topic: /goal with message: 3", (self.kind,)
            )
