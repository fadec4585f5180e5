"""Launch files as part of a job: what they start becomes entries of ``nodes:``."""

from rsltrace.launch.expand import Expanded, expand

__all__ = ["Expanded", "expand"]
