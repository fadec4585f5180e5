"""What a run is to do: job files and jobs built in Python, strictly validated, never executed.

The names are loaded when first used: ``rsltrace.job.times`` serves those who need no pydantic.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsltrace.job.bag import BagSpec, QosSpec
    from rsltrace.job.guard import GuardSpec, SourceSpec, policy_of
    from rsltrace.job.hooks import HooksSpec
    from rsltrace.job.job import Job
    from rsltrace.job.launch_spec import LaunchSpec
    from rsltrace.job.load import job_from_text, load_job, locate, showing_line
    from rsltrace.job.node import NodeSpec
    from rsltrace.job.spec import RecordSpec, StopSpec, TopicStop

_HOMES = {
    "BagSpec": "bag",
    "GuardSpec": "guard",
    "HooksSpec": "hooks",
    "Job": "job",
    "LaunchSpec": "launch_spec",
    "NodeSpec": "node",
    "QosSpec": "bag",
    "RecordSpec": "spec",
    "SourceSpec": "guard",
    "StopSpec": "spec",
    "TopicStop": "spec",
    "job_from_text": "load",
    "load_job": "load",
    "locate": "load",
    "showing_line": "load",
    "policy_of": "guard",
}

__all__ = [
    "BagSpec",
    "GuardSpec",
    "HooksSpec",
    "Job",
    "LaunchSpec",
    "NodeSpec",
    "QosSpec",
    "RecordSpec",
    "SourceSpec",
    "StopSpec",
    "TopicStop",
    "job_from_text",
    "load_job",
    "locate",
    "policy_of",
    "showing_line",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
