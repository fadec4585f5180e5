"""What can only be watched: calls whose answers the run cannot make, reported as findings."""
