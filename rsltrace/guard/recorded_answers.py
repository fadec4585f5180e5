"""Values that came from outside of a run: kept in the trace, and given again in a re-run.

They are written as JSON: a trace can come from anywhere, and reading one must never run code. What
went wrong outside (no such file, connection refused) is a value, too.
"""

from __future__ import annotations

import base64
import binascii
import json
import socket
import ssl
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from rsltrace.errors import GuardError
from rsltrace.trace.model.finding import Finding, Mode

# What nodes were told by clocks and by chance, as far as counts and next answers need it.

LOOK_NS = 1_000
"""What looking at a clock again takes: ``time.time()`` of this century cannot show much less."""
AHEAD_NS_MAX = 1_000_000


class RandomFunction:
    """What draws for a node that calls one function, and how often user code did."""

    __slots__ = ("count", "function")

    def __init__(self, function: Callable[..., Any]) -> None:
        self.count = 0
        self.function = function


class ShownTime:
    """How far what the clocks of a node showed last was ahead of simulated time, which was
    ``now_ns``."""

    __slots__ = ("ahead_ns", "now_ns")

    def __init__(self) -> None:
        self.now_ns, self.ahead_ns = -1 << 63, 0

    def see(self, now_ns: int) -> None:
        """Take note of the time, which may have been there before, or jumped backwards."""
        ahead_ns = self.now_ns + self.ahead_ns - now_ns
        if ahead_ns < 0 or now_ns < self.now_ns:
            ahead_ns = 0
        elif ahead_ns < AHEAD_NS_MAX:
            ahead_ns += LOOK_NS
        self.now_ns, self.ahead_ns = now_ns, ahead_ns


class ClockFunction:
    """One clock function of a node: how often user code looked, and what all of its clocks show."""

    __slots__ = ("looks", "shown")

    def __init__(self, shown: ShownTime) -> None:
        self.looks = 0
        self.shown = shown


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
        ChildProcessError,
        ProcessLookupError,
        socket.gaierror,
        socket.herror,
        ssl.SSLError,
        ssl.SSLZeroReturnError,
        ssl.SSLWantReadError,
        ssl.SSLWantWriteError,
        ssl.SSLSyscallError,
        ssl.SSLEOFError,
        ssl.SSLCertVerificationError,
    )
}
_TLS_DETAILS = ("reason", "library", "verify_code", "verify_message")


@dataclass(frozen=True, slots=True)
class RecordedAnswer:
    """What an earlier run has of one call: the answer, and how many steps it took to come.

    ``text`` is None if the run ended before the answer came.
    """

    text: str | None
    steps: int


class RecordedAnswers:
    """Answers of recorded sources: the real ones, or (in a re-run) those of an earlier run."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, str, int], deque[RecordedAnswer]] | None = None
        self._trace = ""

    def replay(self, findings: Iterable[Finding], trace: str) -> None:
        """Give the recorded answers of an earlier run, to each node in its order."""
        self._kept, self._trace = {}, trace
        for finding in findings:
            if finding.mode is Mode.RECORD:
                of, kept = _parsed(finding.value)
                self._kept.setdefault((finding.node, finding.call, of), deque()).append(kept)

    @property
    def replays(self) -> bool:
        """Whether the answers are those of an earlier run."""
        return self._kept is not None

    def next_answer(self, node: str, call: str, of: int = 0) -> RecordedAnswer:
        """Return the earlier run's next answer to a call, to that object's if it has a number.

        :raises GuardError: if there is no further one.
        """
        assert self._kept is not None
        kept = self._kept.get((node, call, of)) or self._kept.get((node, call, 0))
        if kept:
            return kept.popleft()
        raise GuardError(
            f"{self._trace} has no further answer to {call} of {node or 'the run'}: this run asks "
            "more often than the recorded one did, so its code, job or data have changed; compare "
            "the two with rsltrace diff"
        )


def encoded_answer(real: Callable[[], Any]) -> str:
    """Return what a real call answers as text; an error of the operating system is an answer."""
    try:
        return encoded(real())
    except OSError as error:
        return _error_text(error)


def finding_value(of: int, steps: int, text: str | None) -> str:
    """Return a value for the trace that says whose answer it is and how long it took to come."""
    fields: dict[str, Any] = {"of": of}
    if steps:
        fields["waited"] = steps
    if text is not None:
        fields["then"] = json.loads(text)
    return json.dumps(fields, ensure_ascii=False)


def _parsed(value: str) -> tuple[int, RecordedAnswer]:
    if not value.startswith('{"of"'):
        return 0, RecordedAnswer(value, 0)
    try:
        fields = json.loads(value)
        then = json.dumps(fields["then"], ensure_ascii=False) if "then" in fields else None
        return int(fields["of"]), RecordedAnswer(then, int(fields.get("waited", 0)))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise GuardError(f"a recorded answer cannot be read: {error}") from error


def _error_text(error: OSError) -> str:
    kind = type(error).__name__
    said = [kind if kind in _ERRORS else "OSError", error.errno, error.strerror or str(error)]
    if isinstance(error, ssl.SSLError):
        details = {name: _plain(getattr(error, name, None)) for name in _TLS_DETAILS}
        return json.dumps({"error": [*said, details]})
    return json.dumps({"error": said})


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
            kind, number, text, *details = plain["error"]
            error = _ERRORS.get(kind, OSError)(number, text)
            for name, detail in details[0].items() if details else ():
                if name in _TLS_DETAILS:
                    setattr(error, name, detail)
            raise error
        if "bytes" in plain:
            return base64.b64decode(plain["bytes"], validate=True)
        return tuple(_value(item) for item in plain["tuple"])
    return plain
