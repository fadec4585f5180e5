"""Frozen values that every layer shares: times, entities, events."""
