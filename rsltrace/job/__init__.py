"""What a run is to do: job files and jobs built in Python, strictly validated, never executed."""

from rsltrace.job.job import Job
from rsltrace.job.load import load_job, locate
from rsltrace.job.node import NodeSpec
from rsltrace.job.spec import BagSpec, RecordSpec, StopSpec, TopicStop

__all__ = [
    "BagSpec",
    "Job",
    "NodeSpec",
    "RecordSpec",
    "StopSpec",
    "TopicStop",
    "load_job",
    "locate",
]
