"""Why two runs diverge, in one word each: verdicts and roots."""

from __future__ import annotations

from enum import Enum


class Verdict(Enum):
    """Why two runs diverge. The set is closed; ``Diff.sentence`` puts it in words."""

    IDENTICAL = "identical"
    AS_FAR_AS_THEY_GO = "agree-as-far-as-they-go"
    """One of the recordings is cut, and until there they agree: nobody knows what came after."""
    DIFFERENT_JOBS = "different-jobs"
    """One of the runs has no event to compare, and their jobs or graphs are others."""
    SAME_INPUT_DIFFERENT_OUTPUT = "same-input-different-output"
    DIFFERENT_INPUT = "different-input"
    SCHEDULE = "schedule"
    TIMING = "timing"
    MISSING = "missing"
    EXTRA = "extra"
    ENDED_EARLY = "ended-early"
    RAN_LONGER = "ran-longer"
    EXCEPTION = "exception"
    DRAW = "draw"
    """What chance decided about a message: its delay, whether it is lost."""
    GRAPH = "graph"
    ENVIRONMENT = "environment"
    SAME_CONTENT = "same-content"
    """A run is native, and all messages say the same but for times: what differs is timing, and
    perhaps the order of callbacks."""
    OTHER_CONTENT = "other-content"
    """A run is native, and messages say something else, or are missing."""


class Root(Enum):
    """Where the cause chain of a different input ends."""

    EXTERNAL_INPUT = "external-input"
    """A bag message (or another value from outside) is itself different."""
    CALLBACK = "callback"
    """An event whose inputs agree and whose outputs do not."""
    SCHEDULE = "schedule"
    TIMING = "timing"
    MISSING = "missing"
    EXTRA = "extra"
    EXCEPTION = "exception"
    DRAW = "draw"
    """A delay, a loss or an execution time was drawn differently."""
    JOB = "job"
    """Parameters, seed, code: the constructor already behaved differently."""
    UNKNOWN = "unknown"


ENDED_BY_EXCEPTION = "ended by an exception"
"""In the note of a run that ended so, after its letter."""
