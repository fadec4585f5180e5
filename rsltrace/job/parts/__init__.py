"""The parts of a job: one model for each key of a job file, and how models are walked."""
