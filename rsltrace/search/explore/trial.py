"""One run of a search: its changes to the job, and its result.

The changes are an *overlay* of plain JSON values:

    {"seed": 7, "policy": {…}, "faults": […], "set": {"nodes.0.parameters.speed": 1.2},
     "until": "3s"}

``seed``, ``policy`` and ``faults`` replace these keys of the job, ``set`` any other, by the paths
of ``--set``, ``until`` replaces ``stop.time``. ``JobSource.job(trial).to_yaml()`` is the job file
that repeats a trial: ``rsltrace record`` of that file has its digest.
"""

from __future__ import annotations

import json
import shlex
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from rsltrace.job import Job, job_from_text, load_job

# Which traces of runs that failed are kept: the choice does not depend on who is faster.
#
# Rejected: the traces that come first. Several runs are under way at a time, so the trace of the
# first trial of a cause, which is made small, could come when there were enough.

_KEPT_OF_A_CAUSE = 3


class KeptTraces:
    """Keeps, of each cause of failures, the traces of the trials with the lowest numbers."""

    def __init__(self) -> None:
        self._numbers: dict[str, list[int]] = {}

    def add(self, cause: str, number: int) -> int | None:
        """Take note of a trial that failed; return the trial whose trace is not kept (any more):
        this one, an earlier one that it displaces, or None."""
        kept = self._numbers.setdefault(cause, [])
        place = bisect_left(kept, number)
        if kept[place : place + 1] != [number]:
            kept.insert(place, number)
        return kept.pop() if len(kept) > _KEPT_OF_A_CAUSE else None


CHECK, EXCEPTION, DEADLOCK, LIVELOCK = "check", "exception", "deadlock", "livelock"
UNFINISHED, EXIT, ERROR, CRASH, TIMEOUT = "unfinished", "exit", "error", "crash", "timeout"
"""Kinds of failures. ``unfinished``: the job's ``stop.timeout`` came first. ``exit``: the run ended
with an exit status. ``error``: it did what a simulation does not support, or its order could not be
followed. ``crash``: its process died; ``timeout``: it was killed for taking too long."""

_KEYS = ("seed", "policy", "faults")
_NOT_KEPT = ("behaviours", "order", "steps")


@dataclass(frozen=True, slots=True)
class JobSource:
    """A job as a command line names it: the file, and overrides (name for messages, text).

    ``text`` replaces the file where there is none (a launch file alone). ``begins_recorded``: its
    policy follows a native run first, which trials leave as it is.
    """

    path: str
    overrides: tuple[tuple[str, str], ...] = ()
    text: str | None = None
    folder: str = "."
    begins_recorded: bool = False

    def job(self, trial: Trial | None = None) -> Job:
        """Return the job, with a trial's overlay.

        :raises JobError: it is wrong.
        """
        overrides = [*self.overrides, *(() if trial is None else self.overrides_of(trial))]
        if self.text is not None:
            return job_from_text(self.text, self.path, self.folder, overrides=overrides)
        return load_job(self.path, overrides=overrides)

    def command(self, trial: Trial) -> str:
        """Return the command that runs a trial again, whatever was recorded before."""
        words = ["rsltrace", "record", *([self.path] if self.text is None else [])]
        for _, text in (*self.overrides, *self.overrides_of(trial)):
            words += ["--set", text]
        return shlex.join([*words, "-o", "found.mcap", "--force"])

    def overrides_of(self, trial: Trial) -> Iterator[tuple[str, str]]:
        """Yield the overlay of a trial as overrides of this job: (name for messages, text)."""
        for key, value in trial.overlay.items():
            if key == "policy" and self.begins_recorded:
                more = {f"policy.{name}": one for name, one in value.items() if name != "after"}
                yield from overrides_of(Trial(trial.number, {"set": more}))
            else:
                yield from overrides_of(Trial(trial.number, {key: value}))


@dataclass(frozen=True, slots=True)
class Trial:
    """A run to be made: the ``number``-th of its search, whose ``why`` says what it tries."""

    number: int
    overlay: Mapping[str, Any]
    why: str = ""


def overrides_of(trial: Trial) -> Iterator[tuple[str, str]]:
    """Yield an overlay as overrides of a job: (name for messages, text)."""
    label = f"trial {trial.number}"
    for key, value in trial.overlay.items():
        if key == "set":
            for path, given in value.items():
                yield label, f"{path}={_yaml(given)}"
        elif key == "until":
            yield label, f"stop.time={_yaml(value)}"
        elif key in _KEYS:
            yield label, f"{key}={_yaml(value)}"
        else:
            raise ValueError(f"an overlay has no {key!r}")


def _yaml(value: Any) -> str:
    return json.dumps(_literal(value))


def _literal(value: Any) -> Any:
    """Keep ``$(…)`` in texts from being replaced when they are read."""
    if isinstance(value, str):
        return value.replace("$(", "\\$(")
    if isinstance(value, Mapping):
        return {str(key): _literal(item) for key, item in value.items()}
    return [_literal(item) for item in value] if isinstance(value, (list, tuple)) else value


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a run failed.

    ``kind`` is one of the words above. ``key`` is the same for failures of one cause (a check's
    name; an exception's type and line), ``event`` the event that shows it, if any.
    """

    kind: str
    text: str
    key: str
    event: int | None = None


@dataclass(frozen=True, slots=True)
class TrialStep:
    """One choice of the policy, for a search that changes the order.

    ``ready`` are the names of all that could run, ``chosen`` is the index of the one that did; the
    n-th event of an entity is ``name #n`` in every order. A ``phase`` ends when nothing is left to
    run. ``touches`` are the names that the step read (False) or wrote (True): steps of one phase
    commute unless one writes what the other touches. ``state`` is a hash of everything at the
    beginning of the phase.
    """

    ready: tuple[str, ...]
    chosen: int
    phase: int
    touches: Mapping[str, bool]
    state: str


@dataclass(frozen=True, slots=True)
class TrialResult:
    """The result of a trial. Times are simulated nanoseconds, ``wall_s`` is real time.

    ``choices`` is how often more than one entity could run, ``entities`` how many could,
    ``choices_before`` the choices up to the time after which runs are forked. ``why_not_forked``:
    why it was not forked, if it should have been. Only on request: ``behaviours`` are hashes of
    what happened (an event with content and state, pairs of events of a node), ``order`` is (taken,
    of how many) for each choice, ``steps`` more of that. ``trace`` is the path, if it was kept.
    """

    trial: Trial
    digest: str = ""
    events: int = 0
    end_ns: int = 0
    choices: int = 0
    entities: int = 0
    choices_before: int = 0
    is_forked: bool = False
    why_not_forked: str = ""
    failure: Failure | None = None
    metrics: Mapping[str, float] = field(default_factory=dict)
    wall_s: float = 0.0
    trace: str | None = None
    final_state: str = ""
    behaviours: tuple[int, ...] = ()
    order: tuple[tuple[int, int], ...] = ()
    steps: tuple[TrialStep, ...] = ()

    def as_values(self) -> dict[str, Any]:
        """Return the result as JSON values."""
        return asdict(self)

    def row(self) -> dict[str, Any]:
        """Return the row of a table: without behaviours, order and steps."""
        values = asdict(replace(self, behaviours=(), order=(), steps=()))
        return {key: value for key, value in values.items() if key not in _NOT_KEPT}


def result_of(values: Mapping[str, Any]) -> TrialResult:
    """Return the result that ``as_values`` or ``row`` wrote."""
    given = dict(values)
    given["trial"] = Trial(**given["trial"])
    if given.get("failure") is not None:
        given["failure"] = Failure(**given["failure"])
    given["behaviours"] = tuple(given.get("behaviours", ()))
    given["order"] = tuple((one, two) for one, two in given.get("order", ()))
    given["steps"] = tuple(
        TrialStep(tuple(one["ready"]), one["chosen"], one["phase"], one["touches"], one["state"])
        for one in given.get("steps", ())
    )
    return TrialResult(**given)
