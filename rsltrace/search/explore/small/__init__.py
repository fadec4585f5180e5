"""A run that fails, made small, and handed over as a folder that reproduces it.

ddmin      delta debugging: the fewest of some things with which something still fails
reduction  the fewest departures, faults and settings, the shortest time, the fewest nodes
folder     job, failing and passing trace, their diff, a README and a test
"""
