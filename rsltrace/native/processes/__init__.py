"""Native runs in which each entry of the job is a process of its own.

``run`` starts them (``children``) and merges what they tell into one trace; ``child`` is what each
of them runs. What they say to each other goes over a ``wire.Link``.
"""
