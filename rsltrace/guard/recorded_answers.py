"""Answers from outside of a run: kept in the trace, and returned again in a re-run.

They are JSON, because a trace may come from anywhere and reading one must never run code. An error
(no such file, connection refused) is an answer, too.
"""

from __future__ import annotations

import base64
import binascii
import json
import socket
import sys
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from rsltrace.errors import GuardError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.finding import Finding, GuardMode

# Clocks and random functions, as far as counts and further answers need them.

LOOK_NS = 1_000
"""The time that one more read of a clock takes: ``time.time()`` cannot show much less."""
AHEAD_NS_MAX = 1_000_000


class RandomFunction:
    """A function that draws for one node, and how often user code called it."""

    __slots__ = ("count", "function")

    def __init__(self, function: Callable[..., Any]) -> None:
        self.count = 0
        self.function = function


class ShownTime:
    """The simulated time that a node's clocks showed last, and how far they were ahead of it."""

    __slots__ = ("ahead_ns", "now_ns")

    def __init__(self) -> None:
        self.now_ns, self.ahead_ns = -1 << 63, 0

    def see(self, now_ns: int) -> None:
        """Note a new time, which may equal the last one or lie before it."""
        ahead_ns = self.now_ns + self.ahead_ns - now_ns
        if ahead_ns < 0 or now_ns < self.now_ns:
            ahead_ns = 0
        elif ahead_ns < AHEAD_NS_MAX:
            ahead_ns += LOOK_NS
        self.now_ns, self.ahead_ns = now_ns, ahead_ns


class ClockFunction:
    """One clock function of a node: how often user code called it, and the node's shown time."""

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
    )
}
_TLS_ERRORS = (
    *("SSLError", "SSLZeroReturnError", "SSLWantReadError", "SSLWantWriteError"),
    *("SSLSyscallError", "SSLEOFError", "SSLCertVerificationError"),
)
"""Errors of ``ssl``."""
_TLS_DETAILS = ("reason", "library", "verify_code", "verify_message")


@dataclass(frozen=True, slots=True)
class RecordedAnswer:
    """An answer of an earlier run, and how many steps of simulated time it took.

    ``text`` is None if the run ended before the answer came.
    """

    text: str | None
    steps: int


class RecordedAnswers:
    """Answers from outside: the real ones or, in a re-run, those of an earlier run."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, str, int], deque[RecordedAnswer]] | None = None
        self._trace = ""

    def replay(self, findings: Iterable[Finding], trace: str) -> None:
        """Use the recorded answers of an earlier run, for each node in order."""
        self._kept, self._trace = {}, trace
        for finding in findings:
            if finding.mode is GuardMode.RECORD:
                number, kept = _parsed(finding.value)
                self._kept.setdefault((finding.node, finding.call, number), deque()).append(kept)

    @property
    def replays(self) -> bool:
        """Whether the answers are those of an earlier run."""
        return self._kept is not None

    def next_answer(self, node: str, call: str, number: int = 0) -> RecordedAnswer:
        """Return the earlier run's next answer to a call (to that object's, if it has a number).

        :raises GuardError: if there is none.
        """
        assert self._kept is not None
        kept = self._kept.get((node, call, number)) or self._kept.get((node, call, 0))
        if kept:
            return kept.popleft()
        raise GuardError(
            f"{self._trace} has no further answer to {call} of {node or 'the run'}: this run calls "
            "it more often than the recorded one, so code, job or data have changed; compare "
            "the two with rsltrace diff"
        )


def encoded_answer(real: Callable[[], Any]) -> str:
    """Return the answer of a real call as text; an operating system error is an answer."""
    try:
        return encoded(real())
    except OSError as error:
        return _error_text(error)


def finding_value(number: int, steps: int, text: str | None) -> str:
    """Return a value for the trace: the object's number, the steps waited and the answer."""
    fields: dict[str, Any] = {"of": number}
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
    known = kind in _ERRORS or kind in _TLS_ERRORS
    said = [kind if known else "OSError", error.errno, error.strerror or str(error)]
    if "ssl" in sys.modules and isinstance(error, _tls_error("SSLError")):
        details = {name: _plain(getattr(error, name, None)) for name in _TLS_DETAILS}
        return json.dumps({"error": [*said, details]})
    return json.dumps({"error": said})


def _tls_error(kind: str) -> type[OSError]:
    import ssl  # which code that meets such errors has loaded

    found: type[OSError] = getattr(ssl, kind)
    return found


def encoded(value: Any) -> str:
    """Return a value as JSON: numbers, texts, bytes, None, and lists and tuples of them."""
    return json.dumps(_plain(value), ensure_ascii=False)


def decoded(text: str) -> Any:
    """Return the value of ``encoded``, or raise the error that it stands for.

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
            made = _tls_error(kind) if kind in _TLS_ERRORS else _ERRORS.get(kind, OSError)
            error = made(number, text)
            for name, detail in details[0].items() if details else ():
                if name in _TLS_DETAILS:
                    setattr(error, name, detail)
            raise error
        if "bytes" in plain:
            return base64.b64decode(plain["bytes"], validate=True)
        return tuple(_value(item) for item in plain["tuple"])
    return plain
