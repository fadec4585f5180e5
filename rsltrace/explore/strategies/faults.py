"""Faults: single messages lost, late or twice, and nodes that crash, hang or start again."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from rsltrace.chance.network import QUIET_TOPICS
from rsltrace.chance.stream import Stream
from rsltrace.errors import ExploreError
from rsltrace.explore.strategies.strategy import Proposal
from rsltrace.explore.trial import TrialResult
from rsltrace.job import Job
from rsltrace.job.dump import plain_part
from rsltrace.model.entity import EntityKind
from rsltrace.model.event import OutputKind
from rsltrace.run.plans.bags import PLAYER
from rsltrace.trace.reader import Trace

_MOST = 3
_SHORTEST_NS = 1_000_000
_OF_MESSAGES = ("drop", "delay", "duplicate")


class FaultWalk:
    """Up to three random faults a run, beside those of the job: of what there is in the plain run.

    Order and seed are the job's.
    """

    behaviours = False
    steps = False

    def __init__(self, job: Job, seed: int = 0) -> None:
        self._own = [plain_part(fault) for fault in job.faults]
        self._seed = seed
        self._topics: dict[str, int] = {}
        self._nodes: dict[str, bool] = {}
        self._events = self._longest_ns = 1
        self._kinds: Counter[str] = Counter()
        self._tried = 0

    def begin(self, plain: TrialResult) -> None:
        """See which nodes and messages there are, and when the nodes are all made."""
        if plain.trace is None:
            raise ExploreError("the run of the job as it is has no trace: nothing to disturb")
        with Trace.open(plain.trace) as trace:
            self._longest_ns = max(trace.end_ns - trace.start_ns, 2 * _SHORTEST_NS)
            self._events = max(trace.ended_after or trace.event_count, 1)
            sent: Counter[int] = Counter()
            for rows in trace.outputs():
                wanted = rows["entity"][rows["kind"] == OutputKind.MESSAGE]
                numbers, counts = np.unique(wanted, return_counts=True)
                sent.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
            for entity in trace.entities.values():
                if entity.kind is EntityKind.NODE and entity.name != f"/{PLAYER}":
                    self._nodes[entity.name] = bool(entity.type)  # others have a real process
                elif sent[entity.id] and entity.name not in QUIET_TOPICS:
                    self._topics[entity.name] = self._topics.get(entity.name, 0) + sent[entity.id]
        if not self._nodes and not self._topics:
            raise ExploreError("there are neither nodes nor messages that could be disturbed")

    def propose(self, number: int) -> Proposal | None:
        draw = Stream(self._seed, f"faults\0{number}")
        faults = [self._fault(draw) for _ in range(1 + draw.below(_MOST))]
        self._count(faults)
        why = "; ".join(", ".join(f"{k} {v}" for k, v in fault.items()) for fault in faults)
        return Proposal({"faults": [*self._own, *faults]}, why)

    def learn(self, result: TrialResult) -> TrialResult | None:
        """Learn nothing."""
        return None

    def recall(self, result: TrialResult) -> None:
        self._count(result.trial.overlay.get("faults", [])[len(self._own) :])

    def coverage(self) -> list[str]:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(self._kinds.items()))
        return [
            f"faults: {self._tried} runs with up to {_MOST} each ({kinds}), among "
            f"{sum(self._topics.values())} messages of {len(self._topics)} topics and "
            f"{len(self._nodes)} nodes"
        ]

    def _count(self, faults: list[dict[str, Any]]) -> None:
        self._tried += 1
        self._kinds.update(next(iter(fault)) for fault in faults)

    def _fault(self, draw: Stream) -> dict[str, Any]:
        if self._topics and (not self._nodes or draw.below(2)):
            topic = list(self._topics)[draw.below(len(self._topics))]
            kind = _OF_MESSAGES[draw.below(len(_OF_MESSAGES))]
            fault = {kind: topic, "message": 1 + draw.below(self._topics[topic])}
            return fault if kind == "drop" else {**fault, "by": self._time(draw)}
        node = list(self._nodes)[draw.below(len(self._nodes))]
        kinds = ("crash", "restart", "hang") if self._nodes[node] else ("crash", "restart")
        kind = kinds[draw.below(len(kinds))]
        fault = {kind: node, "event": draw.below(self._events)}
        return fault if kind == "crash" else {**fault, "for": self._time(draw)}

    def _time(self, draw: Stream) -> str:
        """Draw how long something lasts, evenly in its logarithm, in whole milliseconds."""
        ratio = self._longest_ns / _SHORTEST_NS
        return f"{max(round(math.exp(draw.uniform() * math.log(ratio))), 1)}ms"
