"""Every key of a job file, with the part that reads it: here a key is added."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rsltrace.job.parts.field import Field
from rsltrace.job.parts.guard import GuardSpec, guard_part
from rsltrace.job.parts.keys import later
from rsltrace.job.parts.node import NodeSpec
from rsltrace.job.parts.part import JobPart
from rsltrace.job.parts.record import HooksSpec, RecordSpec
from rsltrace.job.parts.stop import StopSpec
from rsltrace.job.values.checks import (
    attach,
    check,
    flag,
    given,
    items,
    named_parts,
    one_of,
    part,
    parts,
    text,
    whole,
)
from rsltrace.job.values.mappings import check_path
from rsltrace.job.values.names import check_topic
from rsltrace.job.values.problem import JobProblem, Loc, describe
from rsltrace.job.values.times import TimeLike, parse_time

if TYPE_CHECKING:
    from rsltrace.job.parts.bag import BagSpec
    from rsltrace.job.parts.check import CheckSpec, MetricSpec
    from rsltrace.job.parts.clocks import ClockSpec
    from rsltrace.job.parts.delay import DelaysSpec
    from rsltrace.job.parts.fault import FaultSpec
    from rsltrace.job.parts.launch import LaunchSpec
    from rsltrace.job.parts.scheduling import ExecutionSpec, ExecutorSpec, PolicySpec, ThreadsSpec
    from rsltrace.job.parts.vary import VarySpec
else:
    # What most jobs do without: importing all parts takes as long as reading a job.
    _PARTS = "rsltrace.job.parts."
    globals().update(
        later(f"{_PARTS}bag", "BagSpec")
        | later(f"{_PARTS}check", "CheckSpec", "MetricSpec")
        | later(f"{_PARTS}clocks", "ClockSpec")
        | later(f"{_PARTS}delay", "DelaysSpec")
        | later(f"{_PARTS}fault", "FaultSpec")
        | later(f"{_PARTS}launch", "LaunchSpec")
        | later(f"{_PARTS}scheduling", "ExecutionSpec", "ExecutorSpec", "PolicySpec", "ThreadsSpec")
        | later(f"{_PARTS}vary", "VarySpec")
    )

SEED_MAX = 2**64 - 1
LIVELOCK_LIMIT = 100_000


def _folder(value: object) -> Path:
    return Path(os.path.abspath(check_path(value)))


def _word(value: object) -> str:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise JobProblem(f"expected a word of a command line, got {describe(value)}")
    return str(getattr(value, "text", value))


attach(_word, schema={"type": ["string", "number"]})


def _metric_name(name: str) -> None:
    """Raise ``ValueError`` unless ``name`` can be the name of a metric: one line of text."""
    if not name.strip() or not name.isprintable():
        raise ValueError(f"{describe(name)} is no name: use a word, as in distance")


attach(_metric_name, pattern=r"\S")


def _clocks(value: object) -> object:
    """Let one mapping stand for a list with it."""
    if isinstance(value, dict):
        return (value,)
    if not isinstance(value, (list, tuple)):
        raise JobProblem(
            "expected a list of clocks, or what is different about all of them "
            f"(advances: true), got {describe(value)}"
        )
    return tuple(value)


def _policy(value: object) -> object:
    if not isinstance(value, str):
        return value
    from rsltrace.job.parts.scheduling import policy_named

    return policy_named(value)


_EXECUTORS: dict[str, list[dict[str, Any]]] = {
    "single_threaded": [{"nodes": ["*"], "workers": 1}],
    "per_node": [],
}


def _executors(value: object) -> object:
    """Let ``single_threaded`` and ``per_node`` stand for the lists they mean."""
    if isinstance(value, str) and value in _EXECUTORS:
        value = _EXECUTORS[value]
    if not isinstance(value, (list, tuple)):
        hint = ""
        if isinstance(value, str) and value.startswith("multi"):
            hint = "; write [{workers: 4}]"
        raise JobProblem(
            f"expected {' or '.join(_EXECUTORS)} or a list of executors, got "
            f"{describe(value)}{hint}"
        )
    return tuple(value)


def _files_of(value: object, loc: Loc = ()) -> Iterator[tuple[Loc, str]]:
    """Yield (place, path) of every ``file`` in a part, however deep."""
    if isinstance(value, JobPart):
        for name, field in type(value).fields.items():
            inner = getattr(value, name)
            place = (*loc, field.alias or name)
            if name == "file" and inner is not None:
                yield place, inner
            else:
                yield from _files_of(inner, place)
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _files_of(inner, (*loc, key))
    elif isinstance(value, tuple):
        for index, inner in enumerate(value):
            yield from _files_of(inner, (*loc, index))


COMMAND_LINE = "<command line>"
"""The ``source_name`` of a job of programs on a command line."""


class JobFields(JobPart):
    """The keys of a job, each by itself; ``Job`` adds what must hold between them."""

    nodes: Annotated[tuple[NodeSpec, ...], parts()] = Field(
        default=(),
        description="The nodes to run, constructed in this order.",
        examples=[[{"node": "my_robot.ekf:EkfNode", "parameters": {"frequency": 50.0}}]],
    )
    launch: Annotated[tuple[LaunchSpec, ...], parts("file")] = Field(
        default=(),
        description="Launch files whose nodes join those of `nodes`.",
        examples=[["bringup.launch.xml", {"file": "nav.launch.yaml", "arguments": {"map": "lab"}}]],
    )
    ros_arguments: Annotated[tuple[str, ...], check(items(_word))] = Field(
        default=(),
        description="ROS arguments for all nodes, as after `--ros-args`. They override all else.",
        examples=[["-p", "ekf:rate:=50", "-r", "scan:=/front/scan"]],
    )
    search_path: Annotated[tuple[str, ...], check(items(check_path))] = Field(
        default=(".",),
        description="Folders to search for modules before Python's own path.",
        examples=[[".", "../src"]],
    )
    start_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="start",
        description="Simulated start time. Default: the bags' first message, else 0.",
        examples=["10s"],
    )
    construct_time_ns: Annotated[int | None, check(parse_time, optional=True)] = Field(
        default=None,
        alias="construct_time",
        description="When nodes are constructed. Default: the start.",
        examples=["0s"],
    )
    stop: StopSpec = Field(
        default=StopSpec(),
        description="What ends the run. Default: the end of the bags, or no work left.",
        examples=[{"duration": "60s"}],
    )
    seed: Annotated[int, check(whole(0, SEED_MAX))] = Field(
        default=0,
        description="Seed of all random choices.",
        examples=[7],
    )
    timer_ties: Annotated[Literal["creation", "heap"], check(one_of("creation", "heap"))] = Field(
        default="creation",
        description="Order of timers due at one instant: by `creation`, or as in the `heap` of "
        "RSLCPP.",
        examples=["heap"],
    )
    livelock_limit: Annotated[int, check(whole(1))] = Field(
        default=LIVELOCK_LIMIT,
        description="Maximum number of events at one simulated time.",
        examples=[1000000],
    )
    bags: Annotated[tuple[BagSpec, ...], parts("path")] = Field(
        default=(),
        description="rosbag2 recordings (MCAP or sqlite3) to play, also truncated ones; at "
        "equal times in this order. Recorded services and actions do not play.",
        examples=[["../bags/outdoor", {"path": "lidar.mcap", "topics": ["/scan"]}]],
    )
    progress: Annotated[str | None, check(text(check_topic), optional=True)] = Field(
        default=None,
        description="Topic for the progress of the bags, a `std_msgs/msg/Float32` up to 1.",
        examples=["/rslcpp/progress"],
    )
    hooks: HooksSpec = Field(
        default=HooksSpec(),
        description="Functions called before and after the construction of the nodes.",
        examples=[{"after": "my_robot.setup:wire"}],
    )
    record: RecordSpec = Field(
        default=RecordSpec(),
        description="Which messages the trace keeps.",
        examples=[{"exclude": ["/camera/*"]}],
    )
    guard: Annotated[GuardSpec, guard_part] = Field(
        default=GuardSpec(),
        description="How sources of nondeterminism are handled; `false` allows all.",
        examples=[{"clock": "virtual", "thread": "warn"}, False],
    )
    delay: Annotated[DelaysSpec | None, given] = Field(
        default=None,
        description="Delay, loss and outages of messages.",
        examples=[{"default": "1ms", "topics": {"/scan": {"uniform": {"min": 0, "max": "5ms"}}}}],
    )

    policy: Annotated[PolicySpec | None, check(_policy, optional=True, shorthand="order")] = Field(
        default=None,
        description="Which ready callback runs next. Default: `fifo`.",
        examples=["rate_monotonic", {"recorded": "run1.mcap"}],
    )
    threads: Annotated[ThreadsSpec | None, part("switch")] = Field(
        default=None,
        description="Where threads take turns. Default: where they block.",
        examples=[{"switch": "every_line"}],
    )
    parallel: Annotated[bool, check(flag)] = Field(
        default=False,
        description="Whether processes compute at the same time. For those that share nothing but "
        "ROS: no files, sockets or devices.",
        examples=[True],
    )
    min_time_step_ns: Annotated[int, check(parse_time)] = Field(
        default=0,
        alias="min_time_step",
        description="Smallest step of simulated time. Work due within a step runs late.",
        examples=["1ms"],
    )
    executors: Annotated[
        tuple[ExecutorSpec, ...] | None,
        check(_executors, optional=True, words=tuple(_EXECUTORS)),
    ] = Field(
        default=None,
        description="Simulated executors: one for all nodes (`single_threaded`), one for "
        "each (`per_node`), or a list. Other nodes have one each.",
        examples=["single_threaded", [{"nodes": ["/camera", "/detector"], "workers": 2}]],
    )
    execution: Annotated[ExecutionSpec | None, given] = Field(
        default=None,
        description="Execution times of callbacks.",
        examples=[{"nodes": {"/detector": {"normal": {"mean": "30ms", "sd": "5ms"}}}}],
    )
    clocks: Annotated[tuple[ClockSpec, ...], check(_clocks, or_entry=True)] = Field(
        default=(),
        description="Clocks that differ from simulated time. A single mapping applies to all "
        "nodes.",
        examples=[
            [{"node": "/lidar", "offset": "-20ms", "drift": "50ppm"}],
            {"advances": True},
        ],
    )
    faults: Annotated[tuple[FaultSpec, ...], parts()] = Field(
        default=(),
        description="Faults of single nodes and messages, at exact times.",
        examples=[
            [
                {"crash": "/planner", "at": "2s"},
                {"drop": "/scan", "message": 12, "to": "/slam"},
            ]
        ],
    )
    checks: Annotated[tuple[CheckSpec, ...], parts()] = Field(
        default=(),
        description="Properties of the run. `rsltrace record` and `rsltrace check` exit with 1 "
        "if one fails.",
        examples=[
            [
                {"always": "/odom.pose.pose.position.x < 10"},
                {"never": "log error"},
            ]
        ],
    )

    metrics: Annotated[
        dict[str, MetricSpec], named_parts("expression", _metric_name, what="metrics")
    ] = Field(
        default_factory=dict,
        description="Numbers computed from the finished run, by name.",
        examples=[{"stops": 'count("/stop")'}],
    )

    vary: Annotated[VarySpec | None, given] = Field(
        default=None,
        description="Settings that `rsltrace explore --strategy vary` changes.",
        examples=[{"settings": {"nodes.ekf.parameters.rate": [10.0, 50.0]}, "method": "grid"}],
    )

    # Not keys of a job file, hence ``exclude``: where the job came from.
    base_dir: Annotated[Path, check(_folder)] = Field(
        default_factory=Path.cwd, exclude=True, repr=False
    )
    source_name: Annotated[str, check(text())] = Field(default="<python>", exclude=True, repr=False)
    given_text: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None, alias="source_text", exclude=True, repr=False
    )
    composed: Any = Field(default=None, exclude=True, repr=False)

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            nodes: Sequence[NodeSpec | dict[str, Any]] = (),
            launch: Sequence[LaunchSpec | dict[str, Any] | str] = (),
            ros_arguments: Sequence[str] = (),
            search_path: Sequence[str | os.PathLike[str]] = (".",),
            start: TimeLike | None = None,
            start_ns: int | None = None,
            construct_time: TimeLike | None = None,
            construct_time_ns: int | None = None,
            stop: StopSpec | dict[str, Any] = ...,
            seed: int = 0,
            timer_ties: Literal["creation", "heap"] = "creation",
            livelock_limit: int = LIVELOCK_LIMIT,
            bags: Sequence[BagSpec | dict[str, Any] | str] = (),
            progress: str | None = None,
            hooks: HooksSpec | dict[str, Any] = ...,
            record: RecordSpec | dict[str, Any] = ...,
            guard: GuardSpec | dict[str, Any] | bool = ...,
            delay: DelaysSpec | dict[str, Any] | None = None,
            policy: PolicySpec | dict[str, Any] | str | None = None,
            threads: ThreadsSpec | dict[str, Any] | str | None = None,
            parallel: bool = False,
            min_time_step: TimeLike = 0,
            min_time_step_ns: int = 0,
            executors: Sequence[ExecutorSpec | dict[str, Any]] | str | None = None,
            execution: ExecutionSpec | dict[str, Any] | None = None,
            clocks: Sequence[ClockSpec | dict[str, Any]] | dict[str, Any] = (),
            faults: Sequence[FaultSpec | dict[str, Any]] = (),
            checks: Sequence[CheckSpec | dict[str, Any]] = (),
            metrics: Mapping[str, MetricSpec | dict[str, Any] | str] = ...,
            vary: VarySpec | dict[str, Any] | None = None,
            base_dir: str | os.PathLike[str] = ...,
            source_name: str = "<python>",
            source_text: str | None = None,
        ) -> None: ...

    def resolve(self, path: str) -> Path:
        """Return a path of the job as an absolute path."""
        return Path(os.path.normpath(self.base_dir / path))

    def model_files(self) -> Iterator[tuple[Loc, str]]:
        """Yield (place in the job, path) of the files that its delays come from."""
        yield from _files_of(self.delay, ("delay",))
        yield from _files_of(self.execution, ("execution",))
        if self.policy is not None and self.policy.recorded is not None:
            yield ("policy", "recorded"), self.policy.recorded
