"""Calls whose answers come from outside: recorded in a run, returned again in a re-run."""
