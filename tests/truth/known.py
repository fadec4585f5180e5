"""What a diff says that is not so, as far as it is known; it shrinks to nothing.

A key is ``class: what is wrong``, or a pattern of such; the value says whether seed 0 shows it.
"""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase

ALWAYS = "always"
SOMETIMES = "sometimes"

KNOWN: dict[str, str] = {
    "QoS that does not fit: *": ALWAYS,
    "another call of a service, hidden: *": ALWAYS,
    "another call of a service, in code: *": ALWAYS,
    "array order, hidden: *": ALWAYS,
    "array order, in code: *": ALWAYS,
    "bag: time: *": ALWAYS,
    "bag: two swapped: *": ALWAYS,
    "bag: value: *": ALWAYS,
    "cancelled timer, hidden: *": ALWAYS,
    "cancelled timer, in code: *": ALWAYS,
    "changed period, hidden: *": ALWAYS,
    "changed period, in code: *": ALWAYS,
    "constant delay: *": ALWAYS,
    "constant in code: *": ALWAYS,
    "deadlock: a call that waits for its own executor: *": ALWAYS,
    "deadlock: executors: *": ALWAYS,
    "delay of all topics: *": ALWAYS,
    "delay that is drawn, seed: *": ALWAYS,
    "delay that only one run has: *": ALWAYS,
    "different jobs: *": ALWAYS,
    "environment variable in a callback: *": ALWAYS,
    "environment variable in the constructor: *": ALWAYS,
    "execution time: *": ALWAYS,
    "executors: *": ALWAYS,
    "fault beside a parameter that nobody declares: *": ALWAYS,
    "fault beside a rule for a topic that is not there: *": ALWAYS,
    "fault beside code of a node that is not concerned: *": ALWAYS,
    "fault beside comments in code: *": ALWAYS,
    "fault beside comments in the job: *": ALWAYS,
    "fault beside layout of the job: *": ALWAYS,
    "fault beside livelock limit: *": ALWAYS,
    "fault beside stop conditions that hold later: *": ALWAYS,
    "fault beside the seed where nothing draws: *": ALWAYS,
    "fault beside what is recorded: *": ALWAYS,
    "file content in a callback: *": ALWAYS,
    "file content in the constructor: *": ALWAYS,
    "guard switched off: *": ALWAYS,
    "log text, hidden: *": ALWAYS,
    "log text, in code: *": ALWAYS,
    "namespace: *": ALWAYS,
    "not published, hidden: *": ALWAYS,
    "order of two publishes, hidden: *": ALWAYS,
    "order of two publishes, in code: *": ALWAYS,
    "outage: *": ALWAYS,
    "parameter set, hidden: *": ALWAYS,
    "parameter set, in code: *": ALWAYS,
    "parameter value: *": ALWAYS,
    "period in code: *": ALWAYS,
    "process id: *": ALWAYS,
    "published a call later, hidden: *": ALWAYS,
    "published a call later, in code: *": ALWAYS,
    "published twice, hidden: *": ALWAYS,
    "published twice, in code: *": ALWAYS,
    "queue depth: *": ALWAYS,
    "queue that overflows because its node is slow: *": ALWAYS,
    "random drawn once more: *": ALWAYS,
    "renamed node: *": ALWAYS,
    "renamed node in code: *": ALWAYS,
    "response, hidden: *": ALWAYS,
    "response, in code: *": ALWAYS,
    "seed of nodes that draw: *": ALWAYS,
    "slept, hidden: *": ALWAYS,
    "slept, in code: *": ALWAYS,
    "smallest time step: *": ALWAYS,
    "start: *": ALWAYS,
    "state only, hidden: *": ALWAYS,
    "state only, in code: *": ALWAYS,
    "state, shown later, hidden: *": ALWAYS,
    "state, shown later, in code: *": ALWAYS,
    "subscription gone, hidden: *": ALWAYS,
    "subscription gone, in code: *": ALWAYS,
    "the same file in two folders: *": ALWAYS,
    "unseeded random: *": ALWAYS,
    "value, hidden: *": ALWAYS,
    "value, in code: *": ALWAYS,
    "wall clock: *": ALWAYS,
}


def item_of(key: str) -> str:
    """Return whether something that is wrong is known, "" if nobody knows of it."""
    return next((why for known, why in KNOWN.items() if fnmatchcase(key, known)), "")


def mended(keys: Iterable[str], names: Iterable[str]) -> list[str]:
    """Return the entries for classes that were tried of which none of ``keys`` is."""
    seen, tried = list(keys), set(names)
    return sorted(
        known
        for known, why in KNOWN.items()
        if why == ALWAYS
        and known.rpartition(": ")[0] in tried
        and not any(fnmatchcase(key, known) for key in seen)
    )
