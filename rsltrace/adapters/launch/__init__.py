"""Launch files as part of a job: what they start becomes entries of ``nodes:``."""
