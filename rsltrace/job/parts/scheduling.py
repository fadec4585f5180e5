"""``policy:``, ``executors:`` and ``execution:`` of a job: what runs when, where, and how long."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from rsltrace.errors import nearest
from rsltrace.job.parts.distribution import DistributionSpec
from rsltrace.job.parts.field import Field
from rsltrace.job.parts.part import JobPart, after_fields
from rsltrace.job.values.checks import (
    Target,
    check,
    check_callable_target,
    items,
    named_parts,
    one_of,
    part,
    parts,
    text,
    whole,
)
from rsltrace.job.values.mappings import check_path
from rsltrace.job.values.names import check_node_glob
from rsltrace.job.values.problem import JobProblem, describe, meant_by
from rsltrace.job.values.times import TimeLike, parse_time

WHEN_BLOCKED, EVERY_LINE = "when_blocked", "every_line"
ORDERS = ("fifo", "rate_monotonic", "wait_set", "rclpy", "permutation")
PRIORITY_MAX = 2**31 - 1

NodeGlob = Annotated[str, check(text(check_node_glob))]
NameGlob = Annotated[str | None, check(text(), optional=True)]


class PriorityRuleSpec(JobPart):
    """A priority for a node, for one of its entities, or for a whole callback group."""

    priority: Annotated[int, check(whole(-PRIORITY_MAX, PRIORITY_MAX))] = Field(
        description="Higher runs first. Default: 0.", examples=[10]
    )
    node: NodeGlob = Field(default="*", description="Node, a glob.", examples=["/controller"])
    entity: NameGlob = Field(
        default=None,
        description="Glob of a topic, service or timer callback.",
        examples=["/scan", "Controller.on_timer"],
    )
    group_of: NameGlob = Field(
        default=None,
        description="Glob of an entity: everything in its callback group.",
        examples=["/scan"],
    )

    @after_fields
    def _not_both(self) -> None:
        if self.entity is not None and self.group_of is not None:
            raise JobProblem("give entity or group_of, not both", ("group_of",), at_key=True)


class DepartureSpec(JobPart):
    """A choice at which a callback other than the first ready one runs."""

    choice: Annotated[int, check(whole(0))] = Field(
        description="Index of the choice. Only times with several candidates count.",
        examples=[37],
    )
    run: Annotated[int, check(whole(0))] = Field(
        description="Index of the candidate, in `fifo` order.",
        examples=[2],
    )
    of: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None,
        description="Node and entity of the candidate; others are an error.",
        examples=["/planner /scan"],
    )


class PctSpec(JobPart):
    """Probabilistic concurrency testing: random priorities, changed at random choices."""

    depth: Annotated[int, check(whole(1, 100))] = Field(
        default=3,
        description="Number of ordering constraints of the bug: 1 for one pair of events.",
        examples=[3],
    )
    choices: Annotated[int, check(whole(1))] = Field(
        default=1000,
        description="Maximum number of choices in a run.",
        examples=[500],
    )


class PolicySpec(JobPart):
    """Which ready callback runs next. Exactly one key besides ``after`` and ``seed``, or
    ``recorded`` with ``after`` and one more; a word alone is an ``order``."""

    ONE_OF: ClassVar[tuple[str, ...]] = (
        "order",
        "priority",
        "departures",
        "pct",
        "recorded",
        "function",
    )
    ALTERNATIVES: ClassVar[tuple[tuple[str, ...], ...]] = tuple(
        (key,) for key in ONE_OF if key != "recorded"
    )

    order: Annotated[str | None, check(one_of(*ORDERS), optional=True)] = Field(
        default=None,
        description="`fifo`: first come, first served, timers last. `rate_monotonic`: "
        "shortest period first. `wait_set`: as rclcpp's executors. `rclpy`: as "
        "rclpy's. `permutation`: random.",
        examples=["rate_monotonic"],
    )
    priority: Annotated[tuple[PriorityRuleSpec, ...] | None, parts(optional=True)] = Field(
        default=None,
        description="Highest priority first. The first matching rule counts.",
        examples=[[{"node": "/controller", "priority": 10}]],
    )
    departures: Annotated[tuple[DepartureSpec, ...] | None, parts(optional=True)] = Field(
        default=None,
        description="`fifo`, except for these choices, which `rsltrace explore` writes.",
        examples=[[{"choice": 37, "run": 2}]],
    )
    pct: Annotated[PctSpec | None, part("depth")] = Field(
        default=None,
        description="Random priorities that change at `depth` - 1 random choices.",
        examples=[{"depth": 3, "choices": 500}],
    )
    recorded: Annotated[str | None, check(check_path, optional=True)] = Field(
        default=None,
        description="A trace whose order is followed exactly; of a native run, until `after`.",
        examples=["run1.mcap"],
    )
    function: Annotated[Target | None, check(check_callable_target, optional=True)] = Field(
        default=None,
        description="Your own policy class (docs/policies.md).",
        examples=["my_robot.policy:LongestQueue"],
    )
    after_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="after",
        description="First come, first served (or as `recorded`) until this time.",
        examples=["30s"],
    )
    seed: Annotated[int | None, check(whole(0), optional=True)] = Field(
        default=None,
        description="Seed of `permutation` and `pct`. Default: the job's.",
        examples=[7],
    )

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            order: str | None = None,
            priority: Sequence[PriorityRuleSpec | dict[str, Any]] | None = None,
            departures: Sequence[DepartureSpec | dict[str, Any]] | None = None,
            pct: PctSpec | dict[str, Any] | int | None = None,
            recorded: str | None = None,
            function: Any = None,
            after_ns: TimeLike | None = None,
            seed: int | None = None,
        ) -> None: ...

    @property
    def begins_recorded(self) -> bool:
        """Whether the order is that of a native run until ``after``, and then the policy's."""
        return self.recorded is not None and self.after_ns is not None

    @property
    def is_plain(self) -> bool:
        """Whether it chooses what came first, at least from ``after`` on."""
        chosen = (self.priority, self.departures, self.pct, self.function)
        if self.recorded is not None and not self.begins_recorded:
            return False
        return self.order in (None, "fifo") and all(one is None for one in chosen)

    @after_fields
    def _one(self) -> None:
        given = [key for key in self.ONE_OF if getattr(self, key) is not None]
        if self.begins_recorded and len(given) == 2:
            given.remove("recorded")
        if len(given) != 1:
            hint = "; recorded with another one needs after, too" if "recorded" in given else ""
            raise JobProblem(f"give one of {', '.join(self.ONE_OF)}{hint}")
        if self.after_ns is not None and given == ["departures"] and not self.begins_recorded:
            raise JobProblem("departures say themselves from when on", ("after",), at_key=True)
        draws = self.pct is not None or self.order == "permutation"
        if self.seed is not None and not draws:
            raise JobProblem("only permutation and pct draw anything", ("seed",), at_key=True)
        choices: set[int] = set()
        for index, departure in enumerate(self.departures or ()):
            if departure.choice in choices:
                raise JobProblem(
                    f"choice {departure.choice} is there twice", ("departures", index, "choice")
                )
            choices.add(departure.choice)


class ExecutorSpec(JobPart):
    """A simulated executor: a number of workers for some nodes."""

    nodes: Annotated[tuple[str, ...], check(items(text(check_node_glob)))] = Field(
        default=("*",), description="Nodes, as globs.", examples=[["/camera", "/detector"]]
    )
    workers: Annotated[int, check(whole(1, 1024))] = Field(
        default=1,
        description="Number of callbacks it runs in parallel.",
        examples=[4],
    )


class EntityExecutionSpec(DistributionSpec):
    """Execution times of some entities."""

    node: NodeGlob = Field(default="*", description="Node, a glob.", examples=["/detector"])
    entity: Annotated[str, check(text())] = Field(
        description="Glob of a topic, service or timer callback.", examples=["/image"]
    )


class ExecutionSpec(JobPart):
    """Execution times: the first match among ``entities``, ``nodes`` and ``default``."""

    MEANT: ClassVar[str] = "default"

    default: Annotated[DistributionSpec | None, part("constant")] = Field(
        default=None, description="Default of all callbacks.", examples=["1ms"]
    )
    nodes: Annotated[dict[str, DistributionSpec], named_parts("constant", check_node_glob)] = Field(
        default_factory=dict,
        description="By node glob.",
        examples=[{"/detector": {"normal": {"mean": "30ms", "sd": "5ms"}}}],
    )
    entities: Annotated[tuple[EntityExecutionSpec, ...], parts()] = Field(
        default=(),
        description="By entity.",
        examples=[[{"node": "/detector", "entity": "/image", "constant": "50ms"}]],
    )


class ThreadsSpec(JobPart):
    """Where threads of one process take turns."""

    switch: Annotated[str, check(one_of(WHEN_BLOCKED, EVERY_LINE))] = Field(
        default=WHEN_BLOCKED,
        description="`when_blocked`: when a thread blocks or ends. `every_line`: before "
        "each line of user code.",
        examples=["every_line"],
    )


def policy_named(value: str) -> dict[str, str]:
    """Return what a word stands for: ``{order: word}``."""
    if value in PolicySpec.ONE_OF:
        example = PolicySpec.fields[value].examples or [None]
        shown = json.dumps({value: example[0]}).replace('"', "")
        raise JobProblem(f"{value!r} alone does not say enough; write for example {shown}")
    if value not in ORDERS:
        word, names = value.lower(), [*ORDERS, *PolicySpec.ONE_OF]
        near = meant_by(word, names) or nearest(word, names)
        hint = f"; did you mean {near}?" if near else ""
        raise JobProblem(
            f"expected {' or '.join(ORDERS)}, or a mapping with "
            f"{' or '.join(PolicySpec.ONE_OF[1:])}, got {describe(value)}{hint}"
        )
    return {"order": value}
