"""Recording nodes natively: rclpy's own executors over DDS, in real time, observed and not steered.

``session.run_natively`` runs a job; ``boundary`` and ``executors`` say to the ``ledger`` what they
see of it, and ``pen`` writes that down as a trace. ``apart`` has a process for each entry.
``docs/native.md`` has what a user should know.
"""
