"""Run events and record them."""
