"""Replay one node alone with its recorded inputs, and compare its outputs."""
