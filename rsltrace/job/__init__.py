"""What a run is to do: job files and jobs built in Python, strictly validated, never executed.

The names are loaded when first used: ``values.times`` serves those who need no part of a job.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rsltrace.job.job import Job
    from rsltrace.job.parts.bag import BagSpec, QosSpec
    from rsltrace.job.parts.check import CheckSpec, MetricSpec
    from rsltrace.job.parts.fault import FaultSpec
    from rsltrace.job.parts.guard import GuardSpec, SourceSpec, policy_of
    from rsltrace.job.parts.launch import LaunchSpec
    from rsltrace.job.parts.node import NodeSpec
    from rsltrace.job.parts.record import HooksSpec, RecordSpec
    from rsltrace.job.parts.stop import StopSpec, TopicStop
    from rsltrace.job.parts.vary import VarySpec
    from rsltrace.job.reading.load import (
        job_from_text,
        load_job,
        locate,
        message_at,
        showing_line,
    )

_HOMES = {
    "BagSpec": "parts.bag",
    "CheckSpec": "parts.check",
    "FaultSpec": "parts.fault",
    "GuardSpec": "parts.guard",
    "HooksSpec": "parts.record",
    "Job": "job",
    "LaunchSpec": "parts.launch",
    "MetricSpec": "parts.check",
    "NodeSpec": "parts.node",
    "QosSpec": "parts.bag",
    "RecordSpec": "parts.record",
    "SourceSpec": "parts.guard",
    "StopSpec": "parts.stop",
    "TopicStop": "parts.stop",
    "job_from_text": "reading.load",
    "load_job": "reading.load",
    "locate": "reading.load",
    "message_at": "reading.load",
    "showing_line": "reading.load",
    "VarySpec": "parts.vary",
    "policy_of": "parts.guard",
}

__all__ = [
    "BagSpec",
    "CheckSpec",
    "FaultSpec",
    "GuardSpec",
    "HooksSpec",
    "Job",
    "LaunchSpec",
    "MetricSpec",
    "NodeSpec",
    "QosSpec",
    "RecordSpec",
    "SourceSpec",
    "StopSpec",
    "TopicStop",
    "VarySpec",
    "job_from_text",
    "load_job",
    "locate",
    "message_at",
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
