"""Searching orders, faults and settings for the run that fails.

trial       what sets one run of a search apart, and what came of it
outcome     one run: its trace, its checks, what is new in it
workers     processes that run one trial after another, each in a copy of themselves
worker      the program of such a process
prefix      processes that have made what runs begin alike with, and are copied for each
copies      what a copy of such a process does
bundle      what a job needs on another machine
cluster     trials on the workers of a Dask cluster
report      what was found: a page, and formats for machines
steps       what a run chose from, and what each thing that ran has touched
behaviour   what a run did, as hashes that others can be compared with
table       the folder with a row for each run
strategies  what is tried next
search      the strategy's trials are run, until the budget is used up
"""
