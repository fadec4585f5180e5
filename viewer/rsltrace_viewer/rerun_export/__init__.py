"""A run on Rerun's timelines: its callbacks, logs, messages and, of two runs, where they diverge.

This package needs the extra ``rerun`` (rerun-sdk, some 500 MB), which nothing else of rsltrace
does: import ``sdk`` first, which says so when it is missing, and the rest behind it.
"""
