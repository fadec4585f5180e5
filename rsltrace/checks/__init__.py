"""What has to be true of a run: the ``checks:`` of a job, held against its trace.

evaluate    all checks of a job, one pass over the trace
properties  always, never, eventually; rates
latency     how long data takes through chains
metrics     numbers of a run, by expressions
conditions  their language, which the debugger and the viewer have, too
"""
