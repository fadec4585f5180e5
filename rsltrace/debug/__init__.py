"""Stopping a run where somebody wants to look, and going back in it."""
