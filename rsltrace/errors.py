"""Every error rsltrace raises on purpose, in one tree, each with the exit status it ends with.

    RsltraceError                    2  anything below; never raised itself
    ├── JobError                     2  the job file cannot be used (file, line, column, what to do)
    ├── SetupError                   2  the machine lacks something: rclpy, an interface package
    ├── BagError                     2  a bag cannot be read or played
    ├── TraceError                   2  a trace cannot be read or compared
    │   ├── TraceFormatError         2  not a trace, or one of another format version
    │   ├── EditError                2  an edit that cannot be understood, or that cannot be made
    │   └── ReplayError              2  it cannot be replayed: its job is not here, or not trusted
    ├── BisectError                  2  the revisions of a job cannot be searched, or not judged
    ├── DebugError                   2  a debugging session cannot do what it is asked
    ├── ExploreError                 2  a search cannot begin or go on: see ``explore``
    ├── OutputError                  2  a trace cannot be written: it exists, no room, no permission
    ├── ConditionError               2  where to stop, or what to evaluate, cannot be understood
    └── RunError                     3  the run itself went wrong; the trace up to there is complete
        ├── NodeError                3  a node's constructor or callback raised
        ├── LivelockError            3  events without end while simulated time stands still
        ├── DeadlockError            3  something waits for what can never come
        ├── UnsupportedError         3  a node used a part of rclpy that a simulation does not have
        └── GuardError               3  a node made a call that its job forbids (see ``guard:``)

A job can end a run with an exit status of its own (see ``stop:``); these are for failures.
An interrupted run (Ctrl-C, SIGTERM, SIGHUP) exits with 130, 143 or 129, as shells expect.
"""

from __future__ import annotations

from collections.abc import Iterable

EXIT_USAGE = 2
EXIT_RUN = 3


class RsltraceError(Exception):
    """Base of all errors a user can act on. ``str(error)`` is the whole message."""

    exit_code: int = EXIT_USAGE


class JobError(RsltraceError):
    """A job that cannot be used.

    What to do: mend the line that the message names; ``rsltrace check`` tries a job without
    running it. ``where`` is ``file:line:column`` (or as much of it as is known); the message begins
    with it.
    """

    def __init__(self, message: str, *, where: str | None = None) -> None:
        super().__init__(f"{where}: {message}" if where else message)
        self.where = where


class SetupError(RsltraceError):
    """Something the run needs is not installed.

    What to do: install what the message names, or source the ROS 2 that has it.
    """


class BagError(RsltraceError):
    """A rosbag2 recording that cannot be read or played.

    What to do: look at the recording with ``ros2 bag info``; of topics that a glob does not fit,
    the message names those that are near. ``glob`` is that of the topics to play which fits none.
    """

    def __init__(self, message: str, *, glob: str | None = None) -> None:
        super().__init__(message)
        self.glob = glob


class TraceError(RsltraceError):
    """A trace that cannot be read or compared.

    What to do: ``rsltrace info --check`` says how far the file is whole. Of a damaged file, record
    the run again: the same job gives the same trace.
    """


class TraceFormatError(TraceError):
    """The file is not an rsltrace trace, or is one of a format this version cannot read.

    What to do: name a file that ``rsltrace record`` wrote; plain recordings can be compared
    (``rsltrace diff``) and looked at (``rsltrace view``), not replayed.
    """


class ReplayError(TraceError):
    """A trace cannot be replayed: what it needs is not here, or nobody has said to trust it.

    What to do: go to the folder of its job, or say ``--trust`` if you know who wrote the trace.
    """


class BisectError(RsltraceError):
    """No commit can be named: no repository, ends that do the same, a check without an answer.

    What to do: compare the two ends by hand first (``rsltrace record`` in each, ``rsltrace diff``).
    """


class DebugError(RsltraceError):
    """A debugging session cannot do what it is asked; it goes on unless the message says not.

    What to do: ``help`` at the prompt lists what can be asked.
    """


class ExploreError(RsltraceError):
    """A search for a failing run cannot begin or go on. What it has found so far is kept.

    What to do: mend what the message names, then go on with ``--resume``.
    """


class EditError(TraceError):
    """An edit that cannot be understood, or that cannot be made where it should be.

    What to do: ``rsltrace cat`` shows the events and their numbers, docs/what-if.md what can be
    changed at which.
    """


class OutputError(RsltraceError):
    """The trace cannot be written.

    What to do: another name (``-o``), ``--force`` to replace what is there, or room on the disk.
    """


class ConditionError(RsltraceError):
    """A breakpoint's condition, or an expression, that cannot be understood or not be evaluated.

    What to do: mend what the carets point at; docs/debugging.md lists what there is to ask.
    ``text`` is what was typed, ``start`` and ``end`` say which characters of it are meant. The
    message shows them.
    """

    def __init__(self, message: str, text: str, start: int = 0, end: int | None = None) -> None:
        self.message = message
        self.text = text
        self.start = min(start, len(text))
        self.end = max(len(text) if end is None else min(end, len(text)), self.start + 1)
        shown = "".join(c if c.isprintable() else "?" for c in text)
        carets = "^" * (self.end - self.start)
        super().__init__(f"{message}\n  {shown}\n  {' ' * self.start}{carets}")


class CheckError(RsltraceError):
    """A check of a job that cannot be held against a run.

    What to do: mend the check's expression or function; docs/checks.md has the forms.
    """


class RunError(RsltraceError):
    """The run went wrong. What happened until then is in the trace.

    What to do: ``rsltrace view`` the trace, from its end backwards.
    """

    exit_code = EXIT_RUN


class NodeError(RunError):
    """User code raised: a constructor or a callback.

    What to do: the traceback names the line; ``rsltrace debug`` stops before it, as often as you
    like. ``node`` and ``entity`` name it, ``stamp_ns`` is the simulated time, ``traceback_text``
    the user's traceback without rsltrace's own frames.
    """

    def __init__(
        self, message: str, *, node: str, entity: str, stamp_ns: int, traceback_text: str
    ) -> None:
        super().__init__(message)
        self.node = node
        self.entity = entity
        self.stamp_ns = stamp_ns
        self.traceback_text = traceback_text


class LivelockError(RunError):
    """Events follow each other without end while simulated time stands still.

    What to do: give one of the callbacks that the message names a timer or a delay, or raise
    ``livelock_limit`` if they do end.
    """


class DeadlockError(RunError):
    """Something waits for what can never come.

    What to do: the message names the line that waits, and for what; ``rsltrace check`` shows who
    offers which service.
    """


class UnsupportedError(RunError):
    """A node used a part of rclpy that the simulation does not offer.

    What to do: what the message says instead; or leave that node out (``nodes:``).
    """


class GuardError(RunError):
    """A node made a call whose answer can differ from run to run, and its job forbids that.

    What to do: take the value from ROS (clock, parameter, message), or let the guard record the
    answers (mode ``record``): docs/guard.md.
    """


def nearest(word: str, names: Iterable[str]) -> str | None:
    """Return the name that ``word`` was most probably meant to be, None if none is near.

    It has the same letters, or is the most similar one; else its last part is (``/robot/scan`` of
    ``scna``).
    """
    import difflib  # only for whoever made a mistake

    every = list(dict.fromkeys(names))
    close = difflib.get_close_matches(word, every, n=3)
    if not close:
        by_end = {name.rsplit("/", 1)[-1]: name for name in reversed(every)}
        ends = difflib.get_close_matches(word.rsplit("/", 1)[-1], by_end, n=3)
        close = [by_end[end] for end in ends]
    swapped = [name for name in close if sorted(name) == sorted(word)]
    return next(iter([*swapped, *close]), None)


def did_you_mean(word: str, names: Iterable[str], otherwise: str = "") -> str:
    """Return the question to end a message with, or ``otherwise`` if no name is near.

    Without an alternative, a semicolon leads to the question.
    """
    near = nearest(word, names)
    if near is None:
        return otherwise
    return f"did you mean {near!r}?" if otherwise else f"; did you mean {near!r}?"


_NAMES_MAX = 8


def near_or_all(word: str, names: Iterable[str]) -> str:
    """Return how a message about an unknown name ends: which name was probably meant, or which
    there are."""
    every = list(dict.fromkeys(names))
    shown = ", ".join(every[:_NAMES_MAX]) + (", …" if len(every) > _NAMES_MAX else "")
    return did_you_mean(word, every) or f"; there are {shown or 'none'}"
