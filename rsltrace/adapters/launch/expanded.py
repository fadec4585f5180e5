"""What becomes of a job with launch files."""

from __future__ import annotations

from typing import NamedTuple

from rsltrace.job import Job


class Expanded(NamedTuple):
    """A job without launch files, and what of them it leaves out or has no use for."""

    job: Job
    notes: tuple[str, ...] = ()
