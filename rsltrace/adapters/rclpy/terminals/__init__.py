"""Terminals that mains read from: what is typed there comes from the job, in simulated time."""
