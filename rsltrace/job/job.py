"""The whole of a job: everything that determines a run, checked before anything is constructed."""

from __future__ import annotations

import os
from typing import Any

from pydantic import model_validator

from rsltrace.job.consistency import contradictions
from rsltrace.job.dump import job_resolved, job_yaml
from rsltrace.job.fields import JobFields
from rsltrace.job.values.problem import Problems


class Job(JobFields):
    """A job, from ``load_job`` or built in Python. Frozen; raises ``JobError`` when wrong.

    Times are integer nanoseconds of simulated time; ``start_ns`` and ``construct_time_ns`` are
    ``None`` where the run decides (first bag message or 0; the start). Paths in it are relative to
    ``base_dir`` (an absolute path; the current folder when built in Python): see ``resolve``.
    """

    @property
    def source_text(self) -> str:
        """The YAML text the job was read from; of one built in Python, or put together from
        several files or with overrides, ``to_yaml()``."""
        if self.composed is not None:
            return f"{self.composed.header()}{self.to_yaml()}"
        return self.to_yaml() if self.given_text is None else self.given_text

    def shown(self, path: str) -> str:
        """Return a path of the job as messages show it: beside the job file as it was named."""
        return os.path.normpath(os.path.join(os.path.dirname(self.source_name), path))

    def to_yaml(self) -> str:
        """Return a job file that loads as this job (from ``base_dir``).

        Classes and functions appear as ``module:qualname``, other Python objects among
        ``arguments`` by the name of their class; a job with local ones does not load again.
        """
        return job_yaml(self)

    def resolved(self) -> dict[str, Any]:
        """Return the job as JSON-compatible values with every default filled in.

        Times are in nanoseconds under the fields' names, paths relative to ``base_dir``, so that
        the result is the same on every machine.
        """
        return job_resolved(self)

    def _repr_html_(self) -> str:
        """Return what a notebook shows of it."""
        from rsltrace.trace.model.html import Sheet

        sheet = Sheet(f"job {self.source_name}")
        sheet.table(
            ("", "runs", "named", "parameters"),
            ((n.kind, n.target, n.name or "", ", ".join(n.parameters)) for n in self.nodes),
        )
        sheet.table(("launch file",), ((one.file,) for one in self.launch))
        sheet.table(("bag",), ((bag.path,) for bag in self.bags))
        sheet.text(self.to_yaml(), summary="as YAML")
        return sheet.html()

    @model_validator(mode="after")
    def _check_whole(self) -> Job:
        problems = list(contradictions(self))
        if problems:
            raise Problems(problems)
        return self
