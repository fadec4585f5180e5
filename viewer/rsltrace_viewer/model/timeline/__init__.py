"""Rows of the timeline: what each says, and which columns fit."""
