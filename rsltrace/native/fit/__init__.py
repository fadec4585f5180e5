"""From a native run to a simulated one: how long messages and callbacks took, as a job says it.

``measurement`` reads a trace, ``models`` makes distributions of what it finds, ``fitted_job``
writes them as parts of a job, ``picture`` draws them. ``docs/fit.md`` has what a user should know.
"""
