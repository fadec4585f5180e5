"""The events of a run: table, lanes, rates, log records."""
