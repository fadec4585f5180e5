"""Searching orders, faults and settings for the run that fails.

trial       what sets one run of a search apart, and what came of it
outcome     one run: its trace, its checks, what is new in it
workers     processes that run one trial after another, each in a copy of themselves
worker      the program of such a process
steps       what a run chose from, and what each thing that ran has touched
behaviour   what a run did, as hashes that others can be compared with
"""
