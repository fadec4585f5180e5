"""Search orders, faults and settings for runs that fail.

trial       the changes and the result of one run of a search
outcome     one run: its trace, its checks, what is new in it
workers     processes that run one trial after another, each in a fork
worker      the program of such a process
prefix      processes that have run a common prefix and are forked for each run
cluster     trials on the workers of a Dask cluster
report      the results: a page, and formats for machines
steps       the choices of a run, what each step touched, and hashes of what happened
table       the folder with a row for each run
strategies  what is tried next
search      the strategy's trials are run, until the budget is used up
"""
