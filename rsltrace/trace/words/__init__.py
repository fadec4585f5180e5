"""Events, entities and outputs of a trace in words, for ``cat``, reports, the viewer and Rerun.

entities  what an entity is called: ``/filter: subscription /scan``
outputs   what an output is: ``/odom``, ``call /plan``, ``new publisher /map``
events    an event of a trace: its node, what ran, everything it did
phrases   an event as part of a sentence: ``subscription /scan of /filter``, ``at 1.5 s``
kinds     kinds and flags: ``guard_condition``, ``sub``, ``raised``
logs      log records
times     times as people type them
matching  names and levels as people type them
"""
