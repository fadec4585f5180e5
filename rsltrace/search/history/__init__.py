"""The history of a suite: a line for each run, and what the lines say of jobs and commits."""
