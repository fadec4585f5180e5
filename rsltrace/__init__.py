"""rsltrace: deterministic record, replay and trace debugging for unmodified rclpy nodes.

>>> import rsltrace
>>> job = rsltrace.load_job("job.yaml")                   # doctest: +SKIP
>>> result = rsltrace.record(job, "run.mcap")             # doctest: +SKIP
>>> result.digest                                         # doctest: +SKIP

The names below are the public API. They are loaded when first used: importing rsltrace loads
neither rclpy nor numpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rsltrace._version import __version__

if TYPE_CHECKING:
    from rsltrace.errors import RsltraceError
    from rsltrace.job import BagSpec, Job, NodeSpec, RecordSpec, StopSpec, TopicStop, load_job
    from rsltrace.run import RunResult, record
    from rsltrace.trace.reader import Trace

_HOMES = {
    "BagSpec": "rsltrace.job",
    "Job": "rsltrace.job",
    "NodeSpec": "rsltrace.job",
    "RecordSpec": "rsltrace.job",
    "RsltraceError": "rsltrace.errors",
    "RunResult": "rsltrace.run",
    "StopSpec": "rsltrace.job",
    "TopicStop": "rsltrace.job",
    "Trace": "rsltrace.trace.reader",
    "load_job": "rsltrace.job",
    "record": "rsltrace.run",
}

__all__ = [
    "BagSpec",
    "Job",
    "NodeSpec",
    "RecordSpec",
    "RsltraceError",
    "RunResult",
    "StopSpec",
    "TopicStop",
    "Trace",
    "__version__",
    "load_job",
    "record",
]


def __getattr__(name: str) -> Any:
    try:
        home = _HOMES[name]
    except KeyError:
        raise AttributeError(f"module 'rsltrace' has no attribute {name!r}") from None
    import importlib

    return getattr(importlib.import_module(home), name)


def __dir__() -> list[str]:
    return __all__
