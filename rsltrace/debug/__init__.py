"""Stopping a run where somebody wants to look, and going back in it.

Who debugs is a client (``rsltrace.DebugSession``, the prompt, the viewer) and lives in a process of
its own. A supervisor owns the processes of the simulation: the one that stands where the session
is, and checkpoints, which are copies of it asleep at earlier events. They speak JSON lines
(docs/debug-protocol.md). Going back is waking the nearest checkpoint before the goal and running
forward from there; every event is compared with what happened there the first time.
"""
