"""Records runs on rclpy's own executors over DDS, in real time: observed, not steered.

``session.run_natively`` runs a job. The observers report to the ``span_recorder``, and
``span_writer`` writes the trace. ``processes`` runs each entry in its own process. See
docs/native.md.
"""
