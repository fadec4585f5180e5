"""Bags, and recordings of native runs: topics and their messages, of one or two files."""
