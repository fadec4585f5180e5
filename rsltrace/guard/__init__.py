"""Sources of nondeterminism: made deterministic where possible, found and reported where not.

Knows neither ROS nor files of ours: a run gives it a ``Context`` to ask for time, node and event,
and a function that takes findings.
"""
