"""Screens over the main one: help, plots, the report, a choice."""
