"""Reduce a failing run, and write a folder that reproduces it.

reduction  delta debugging: the fewest departures, faults, settings and nodes, the shortest time
causes     the folder: job, failing and passing trace, their diff, a README and a test
"""
