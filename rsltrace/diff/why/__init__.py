"""Why a callback did not come, or came late, from the trace of one run.

``answer.REASONS`` lists one class per reason, in one order. A reason is a fact: its ``find`` says
whether it holds for a ``Question``, its ``words`` put it into a sentence.
"""
