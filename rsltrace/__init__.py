"""rsltrace: deterministic record, replay and trace debugging for unmodified rclpy nodes.

>>> import rsltrace
>>> job = rsltrace.load_job("job.yaml")                   # doctest: +SKIP
>>> result = rsltrace.record(job, "run.mcap")             # doctest: +SKIP
>>> result.digest                                         # doctest: +SKIP
>>> rsltrace.diff("run.mcap", "other.mcap").sentence      # doctest: +SKIP

The names below are the public API. They are loaded when first used: importing rsltrace loads
neither rclpy nor numpy. (To pytest, whose plugin it is: PYTEST_DONT_REWRITE.)
"""

from __future__ import annotations

from rsltrace._version import __version__

TYPE_CHECKING = False  # not typing's: a command that is started again has no other use for it
if TYPE_CHECKING:
    from typing import Any

    from rsltrace.checks.evaluate import CheckResult, evaluate_checks
    from rsltrace.checks.latency.measure import ChainLatency, measure_latencies
    from rsltrace.checks.metrics import MetricResult, evaluate_metrics
    from rsltrace.debug.client import DebugSession
    from rsltrace.diff import diff_files as diff
    from rsltrace.diff.bags.comparison import diff_bags
    from rsltrace.diff.facts.causes import Verdict
    from rsltrace.diff.options import DiffOptions
    from rsltrace.diff.result import BagDiff, Diff
    from rsltrace.errors import RsltraceError
    from rsltrace.job import (
        BagSpec,
        CheckSpec,
        FaultSpec,
        HooksSpec,
        Job,
        LaunchSpec,
        MetricSpec,
        NodeSpec,
        RecordSpec,
        StopSpec,
        TopicStop,
        load_job,
    )
    from rsltrace.replay import replay_trace as replay
    from rsltrace.replay.one_node.result import NodeReplayResult
    from rsltrace.replay.replaying import ReplayResult
    from rsltrace.run import RunResult, Simulation, record
    from rsltrace.trace.reader import Trace

_HOMES = {
    "BagDiff": "rsltrace.diff.result",
    "BagSpec": "rsltrace.job",
    "ChainLatency": "rsltrace.checks.latency.measure",
    "CheckResult": "rsltrace.checks.evaluate",
    "CheckSpec": "rsltrace.job",
    "DebugSession": "rsltrace.debug.client",
    "Diff": "rsltrace.diff.result",
    "DiffOptions": "rsltrace.diff.options",
    "FaultSpec": "rsltrace.job",
    "HooksSpec": "rsltrace.job",
    "Job": "rsltrace.job",
    "LaunchSpec": "rsltrace.job",
    "MetricResult": "rsltrace.checks.metrics",
    "MetricSpec": "rsltrace.job",
    "NodeReplayResult": "rsltrace.replay.one_node.result",
    "NodeSpec": "rsltrace.job",
    "RecordSpec": "rsltrace.job",
    "ReplayResult": "rsltrace.replay.replaying",
    "RsltraceError": "rsltrace.errors",
    "RunResult": "rsltrace.run",
    "Simulation": "rsltrace.run",
    "StopSpec": "rsltrace.job",
    "TopicStop": "rsltrace.job",
    "Trace": "rsltrace.trace.reader",
    "Verdict": "rsltrace.diff.facts.causes",
    "diff_bags": "rsltrace.diff.bags.comparison",
    "evaluate_checks": "rsltrace.checks.evaluate",
    "evaluate_metrics": "rsltrace.checks.metrics",
    "load_job": "rsltrace.job",
    "measure_latencies": "rsltrace.checks.latency.measure",
    "record": "rsltrace.run",
}

__all__ = [
    "BagDiff",
    "BagSpec",
    "ChainLatency",
    "CheckResult",
    "CheckSpec",
    "DebugSession",
    "Diff",
    "DiffOptions",
    "FaultSpec",
    "HooksSpec",
    "Job",
    "LaunchSpec",
    "MetricResult",
    "MetricSpec",
    "NodeReplayResult",
    "NodeSpec",
    "RecordSpec",
    "ReplayResult",
    "RsltraceError",
    "RunResult",
    "Simulation",
    "StopSpec",
    "TopicStop",
    "Trace",
    "Verdict",
    "__version__",
    "diff",
    "diff_bags",
    "evaluate_checks",
    "evaluate_metrics",
    "load_job",
    "measure_latencies",
    "record",
    "replay",
]


def __getattr__(name: str) -> Any:
    if name in ("diff", "replay"):
        import importlib

        return importlib.import_module(f"rsltrace.{name}")  # a package that can be called
    try:
        home = _HOMES[name]
    except KeyError:
        raise AttributeError(f"module 'rsltrace' has no attribute {name!r}") from None
    import importlib

    return getattr(importlib.import_module(home), name)


def __dir__() -> list[str]:
    return __all__
