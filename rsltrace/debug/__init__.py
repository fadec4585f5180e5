"""Stop a run at any event, inspect it, and step backwards.

A client (``rsltrace.DebugSession``, the prompt, the viewer) talks to a supervisor process in JSON
lines (docs/debug-protocol.md). The supervisor owns the simulation processes: the one at the
session's position, and checkpoints, its sleeping copies. To go back, it wakes the nearest
checkpoint before the goal and runs forward; each event is compared with its first run.
"""
