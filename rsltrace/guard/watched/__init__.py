"""Libraries whose calls the guard can only report."""
