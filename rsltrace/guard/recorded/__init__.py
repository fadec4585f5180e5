"""What comes from outside: recorded in a run, and given again in a re-run."""
