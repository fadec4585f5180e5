"""Response times of chains: bounds that hold for every run, and the worst that runs have shown.

system     callbacks as parts of chains, on executors
bounds     the analyses: how often work arrives, and how much a processor gives
chains     what a trace shows: chains, their response times, durations of callbacks
model      from a job and a trace to a system
analysis   what ``rsltrace analyze`` knows of each chain
"""
