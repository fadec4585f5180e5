"""The language of conditions: one for checks, metrics, breakpoints, ``cat --where`` and the viewer.

text            a text becomes a condition: ``node /ekf``, ``/odom: pose.pose.position.x > 3``
occurrences     what one event answers, or one compared with what was before it
expressions     expressions about an event: its message, nodes that run
run_expression  expressions about a finished run: metrics, ``bisect --check``
names           what there is in a run, to check names by; ``/odom.pose.x`` is ``/odom: pose.x``
view            an event as a condition sees it; ``trace_events``: one of a trace
evaluation      the language itself: what an expression may have, and what it is worth
functions       its functions; ``operators``: its operators; ``bounds``: how much it may compute

Nothing here is ever run as Python: a text may come from anybody (docs/trust.md).
"""
