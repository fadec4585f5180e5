"""Launch files as part of a job: what they start becomes entries of ``nodes:``."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from rsltrace.job import Job


class JobExpansion(NamedTuple):
    """A job without launch files, and what of them it leaves out or has no use for."""

    job: Job
    notes: tuple[str, ...] = ()
