"""Screens that lie over the main one: help, choices, plots, the report."""
