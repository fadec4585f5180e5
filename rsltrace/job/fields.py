"""Every key of a job file, with the part that reads it: here a key is added."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from rsltrace.job.parts.bag import BagSpec
from rsltrace.job.parts.check import CheckSpec, MetricSpec, check_metric_name
from rsltrace.job.parts.clocks import ClockSpec, clocks_part
from rsltrace.job.parts.delay import DelaysSpec
from rsltrace.job.parts.distribution import files_of
from rsltrace.job.parts.fault import FaultSpec
from rsltrace.job.parts.guard import GuardSpec, guard_part
from rsltrace.job.parts.launch import LaunchSpec
from rsltrace.job.parts.node import NodeSpec
from rsltrace.job.parts.part import JobPart
from rsltrace.job.parts.record import HooksSpec, RecordSpec
from rsltrace.job.parts.scheduling import (
    ExecutionSpec,
    ExecutorSpec,
    PolicySpec,
    ThreadsSpec,
    executors_part,
    policy_part,
)
from rsltrace.job.parts.stop import StopSpec
from rsltrace.job.parts.vary import VarySpec
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

SEED_MAX = 2**64 - 1
LIVELOCK_LIMIT = 100_000


def _folder(value: object) -> Path:
    return Path(os.path.abspath(check_path(value)))


def _word(value: object) -> str:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise JobProblem(f"expected a word of a command line, got {describe(value)}")
    return str(getattr(value, "text", value))


attach(_word, schema={"type": ["string", "number"]})

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

    policy: Annotated[PolicySpec | None, policy_part] = Field(
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
    executors: Annotated[tuple[ExecutorSpec, ...] | None, executors_part] = Field(
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
    clocks: Annotated[tuple[ClockSpec, ...], clocks_part] = Field(
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
        dict[str, MetricSpec], named_parts("expression", check_metric_name, what="metrics")
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
        yield from files_of(self.delay, ("delay",))
        yield from files_of(self.execution, ("execution",))
        if self.policy is not None and self.policy.recorded is not None:
            yield ("policy", "recorded"), self.policy.recorded
