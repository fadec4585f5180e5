"""What has to be true of a run: the ``checks:`` of a job, held against its trace.

evaluate      all checks of a job, one pass over the trace
conditions    the texts of a job, as conditions of the debugger
properties    always, never, eventually; rates
latency       how long data takes through chains
functions     functions of the user's
trace_events  an event of a trace as a condition sees it
"""
