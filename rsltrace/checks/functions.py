"""Checks that are functions of the user's: they get the finished trace."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rsltrace.checks.properties import Violation
from rsltrace.errors import CheckError, RsltraceError
from rsltrace.job.values.target import Target
from rsltrace.run.plans.scheduling import load_target
from rsltrace.trace.reader import Trace


def violations(function: Callable[[Trace], object], name: str, trace: Trace) -> list[Violation]:
    """Call a function and return what it says is wrong.

    :raises CheckError: it raised something else than an AssertionError, or returned
        something that says nothing.
    """
    try:
        said = function(trace)
    except AssertionError as error:
        return [_at_end(trace, str(error) or "it raised AssertionError")]
    except RsltraceError:
        raise
    except Exception as error:
        raise CheckError(f"{name} raised {type(error).__name__}: {error}") from error
    if said is None or said is True:
        return []
    if said is False:
        return [_at_end(trace, "it returned False")]
    if isinstance(said, str):
        return [_at_end(trace, said)]
    if isinstance(said, Iterable):
        return [_violation(trace, name, one) for one in said]
    raise CheckError(
        f"{name} returned {said!r}: nothing or True (all is well), False, a text, or a list of "
        "(event, text)"
    )


def load_function(target: Target) -> Callable[[Trace], object]:
    """Return the function that a check names, imported from the job's search path.

    :raises JobError: there is none.
    """
    if not isinstance(target, str):
        return target
    loaded: Callable[[Trace], object] = load_target(target, where=f"checks: function {target}")
    return loaded


def _at_end(trace: Trace, text: str) -> Violation:
    return Violation(None, trace.end_ns, text)


def _violation(trace: Trace, name: str, said: object) -> Violation:
    if isinstance(said, str):
        return _at_end(trace, said)
    if isinstance(said, tuple) and len(said) == 2 and isinstance(said[1], str):
        index, text = said
        if isinstance(index, int) and 0 <= index < trace.event_count:
            return Violation(int(index), trace.event(int(index)).stamp_ns, text)
    raise CheckError(
        f"{name} returned a list with {said!r}: expected (event, text), with an event of the trace"
    )
