"""Many runs of one job, each in a process of its own."""
