"""Where to stop, as a text: what breakpoints, watches and searches in a run mean.

text         a text becomes a condition: ``node /ekf``, ``/odom: pose.pose.position.x > 3``
occurrences  the conditions that one event answers
changes      those that compare an event with what was before it: a time, ``watch``, ``when``
expressions  Python expressions over messages and nodes, checked before anything runs
names        what there is in a run, to check names by
view         an event as a condition sees it
"""
