"""How long data takes through a graph of nodes: latencies, data ages and reaction times of chains.

paths     chains of topics, distinguished by the nodes that publish them
flow      one pass over a trace: which message came of which, and when
hops      of each step of a chain: link, queue, node; messages that went no further
figures   a series of durations in a few numbers
measure   what is asked for, of a trace
"""
