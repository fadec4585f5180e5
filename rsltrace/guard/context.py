"""What the guard asks of the simulation, whose code it does not know."""

from __future__ import annotations

from typing import Any, Protocol

from rsltrace.trace.model.finding import Policy


class Context(Protocol):
    """What a guard asks of the simulation."""

    direct: tuple[Any, Any] | None
    """Where all clocks show simulated time: what has that (``now_ns``) and the index of the event
    under way (``events``), and what has the node whose code runs (``node``, if any, and its
    ``key``). Looking there oneself takes a fraction of asking ``look`` or ``node``."""

    def now_ns(self) -> int:
        """Return simulated time."""

    def look(self) -> tuple[int, str, int]:
        """Return the index of the event under way, the node and simulated time."""

    def node(self) -> str:
        """Return the node whose code runs, or an empty text."""

    def process(self) -> int:
        """Return which of the run's processes that is: 0 has the nodes that the job constructs,
        the mains count from 1 in the order of the job."""

    def policy(self) -> Policy | None:
        """Return the policy of that node, or None for the job's."""

    def place(self) -> tuple[int, int]:
        """Return the index of the event under way and the entity that runs."""

    def pass_time(self, for_ns: int) -> None:
        """Let simulated time pass, if whoever runs can wait."""

    def is_aside(self) -> bool:
        """Return whether others can go on while whoever runs waits for what is outside."""

    def can_step(self) -> bool:
        """Return whether whoever runs can wait in simulated time at all."""

    def step(self, for_ns: int) -> None:
        """Let simulated time pass while whoever runs waits for what is outside."""
