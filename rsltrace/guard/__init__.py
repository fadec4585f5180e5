"""The guard: makes calls in nodes deterministic where it can, and reports or records the others.

It knows neither ROS nor trace files. A run gives it a ``SimulationContext``, which knows time, node
and event, and a function that takes findings.
"""
