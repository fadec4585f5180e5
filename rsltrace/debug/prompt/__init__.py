"""The prompt of ``rsltrace debug``: a client of a session, as anybody could write one.

shell       reads commands and carries them out, until it is told to quit
commands    what there is to say, with abbreviations and help
show        what is printed: where the run stands, tables of what is in it, source lines
completion  what a line could become
lines       lines from a terminal, a pipe or the command line
"""
