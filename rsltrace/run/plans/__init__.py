"""Prepare the parts of a run from its job: entries, bags, network, scheduling, guard."""
