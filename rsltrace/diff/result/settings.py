"""What differs in how two runs were made."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Setting:
    """A difference outside of the events: keys of the job, versions, entities of the graph.

    ``place`` is ``job.yaml:12``, ``job`` (of no line), ``environment: numpy``, ``entity``; ``key``
    is that of a job as ``--set`` takes it, or empty. ``a``/``b`` are None where a side has nothing
    there.
    """

    place: str
    a: str | None
    b: str | None
    key: str = ""

    def __str__(self) -> str:
        return f"{self.place}: {self.key}" if self.key else self.place
