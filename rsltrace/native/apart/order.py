"""What the process of an entry is told to do."""

from __future__ import annotations

from dataclasses import dataclass

from rsltrace.job import Job
from rsltrace.simulation.loop.policy import PriorityRule


@dataclass(frozen=True, slots=True)
class Order:
    """Which entry of a job's ``nodes:`` to run, or one of these: ``command`` to become another
    program, ``plays_bags`` to play the job's bags.

    ``executor`` is the name of an rclpy class; ``echo`` lets nodes print their log records.
    ``policy`` and its ``rules`` are those of the run's priorities.
    """

    job: Job
    index: int = 0
    executor: str = "SingleThreadedExecutor"
    echo: bool = True
    policy: str | None = None
    rules: tuple[PriorityRule, ...] | None = None
    command: tuple[str, ...] = ()
    plays_bags: bool = False
    module_path: tuple[str, ...] = ()
    """Where the run finds modules."""
