"""What a job is, found out without running it: nodes are constructed, the loop never runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rsltrace.job import Job
from rsltrace.loop.stop import Stop
from rsltrace.run.process import Observer
from rsltrace.run.session import Session

if TYPE_CHECKING:
    from rsltrace.ros.overview import Overview


@dataclass(frozen=True, slots=True)
class Checked:
    """A job that could run: when it starts (simulated ns), its graph, and notes on its bags."""

    job: Job
    start_ns: int
    overview: Overview
    notes: tuple[str, ...]
    unused: tuple[str, ...]
    """What in the job had nothing to do: it names what is not there."""

    @property
    def problems(self) -> tuple[str, ...]:
        """What looks wrong."""
        return (*self.overview.problems, *self.unused)


def check_job(job: Job, *, everything: bool = False) -> Checked:
    """Construct a job's nodes and return their graph; ``everything`` with what every node has.

    :raises JobError, SetupError, BagError: the job cannot run.
    :raises RunError: a constructor raised.
    """
    from rsltrace.ros.overview import overview

    notes: list[str] = []
    with Session(job, None, observer=Observer(note=notes.append)) as session:
        session.begin()
        if session.error is not None:
            error = session.error
            session.stop = session.stop or Stop("checked")
            session.finish()
            raise error
        found = overview(session.world.core, everything=everything)
        unused = session.unused()
        session.stop = Stop("checked")
        session.finish()
        return Checked(session.job, session.start_ns, found, tuple(notes), unused)
