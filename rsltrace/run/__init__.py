"""From a Job to a trace and a result: where the layers below are put together."""

from rsltrace.run.process import Observer
from rsltrace.run.provenance import environment
from rsltrace.run.recording import record, run
from rsltrace.run.session import RunResult
from rsltrace.run.simulation import Simulation

__all__ = ["Observer", "RunResult", "Simulation", "environment", "record", "run"]
