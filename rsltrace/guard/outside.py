"""Values that came from outside of a run: kept in the trace, and given again in a re-run.

They are written as JSON: a trace can come from anywhere, and reading one must never run code. What
went wrong outside (no such file, connection refused) is a value, too.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from rsltrace.errors import GuardError
from rsltrace.model.finding import Finding, Mode

_ERRORS = {
    error.__name__: error
    for error in (
        OSError,
        FileNotFoundError,
        FileExistsError,
        PermissionError,
        IsADirectoryError,
        NotADirectoryError,
        ConnectionRefusedError,
        ConnectionResetError,
        ConnectionAbortedError,
        BrokenPipeError,
        TimeoutError,
        BlockingIOError,
        InterruptedError,
    )
}


class Outside:
    """Answers of recorded sources: the real ones, or (in a re-run) those of an earlier run."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, str], deque[str]] | None = None
        self._trace = ""

    def replay(self, findings: Iterable[Finding], trace: str) -> None:
        """Give the recorded answers of an earlier run, to each node in its order."""
        self._kept, self._trace = {}, trace
        for finding in findings:
            if finding.mode is Mode.RECORD:
                key = finding.node, finding.call
                self._kept.setdefault(key, deque()).append(finding.value)

    def answer(self, node: str, call: str, real: Callable[[], Any]) -> str:
        """Return the answer to a call as text.

        :raises GuardError: if the earlier run has no further answer to this call.
        """
        if self._kept is not None:
            kept = self._kept.get((node, call))
            if kept:
                return kept.popleft()
            raise GuardError(
                f"{self._trace} has no answer to {call} of {node or 'the run'} any more: this run "
                "asks more than the recorded one did, so its code, job or data is another; compare "
                "the two with rsltrace diff"
            )
        try:
            return encoded(real())
        except OSError as error:
            kind = type(error).__name__
            kind = kind if kind in _ERRORS else "OSError"
            return json.dumps({"error": [kind, error.errno, error.strerror or str(error)]})


def encoded(value: Any) -> str:
    """Return a value as JSON: numbers, texts, bytes, None, and lists and tuples of them."""
    return json.dumps(_plain(value), ensure_ascii=False)


def decoded(text: str) -> Any:
    """Return the value of ``encoded``; raise the error that it stands for.

    :raises GuardError: if it is neither.
    """
    try:
        return _value(json.loads(text))
    except (ValueError, TypeError, KeyError, RecursionError, binascii.Error) as error:
        raise GuardError(f"a recorded answer cannot be read: {error}") from error


def _plain(value: Any) -> Any:
    if isinstance(value, (bytes, bytearray)):
        return {"bytes": base64.b64encode(value).decode()}
    if isinstance(value, tuple):
        return {"tuple": [_plain(item) for item in value]}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return None


def _value(plain: Any) -> Any:
    if isinstance(plain, list):
        return [_value(item) for item in plain]
    if isinstance(plain, dict):
        if "error" in plain:
            kind, number, text = plain["error"]
            raise _ERRORS.get(kind, OSError)(number, text)
        if "bytes" in plain:
            return base64.b64decode(plain["bytes"], validate=True)
        return tuple(_value(item) for item in plain["tuple"])
    return plain
