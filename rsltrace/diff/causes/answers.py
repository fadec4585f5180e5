"""What the guard recorded of a call's answer, as a person reads it."""

from __future__ import annotations

import base64
import json
import os
from typing import Any

from rsltrace.model.finding import Finding, Mode
from rsltrace.model.printable import printable, shortened

STARTED_BY = "subprocess.Popen("
_STARTED = "started"
_BEFORE = 20


def answer_text(finding: Finding) -> str:
    """Return ``b'1.5\\n'`` of an answer that is kept as JSON, ``exit status 4`` of how a program
    ended; of a program that was started no more than that, as its number is another one each
    time. Other answers are returned as they are."""
    if finding.mode is not Mode.RECORD:
        return finding.value
    if finding.call.startswith(STARTED_BY) and finding.value.isdecimal():
        return _STARTED
    try:
        value = json.loads(finding.value)
        value = value["then"] if isinstance(value, dict) and "of" in value else value
        return _exit_text(value) if finding.call == "os.waitpid()" else _text(value)
    except (ValueError, TypeError, KeyError, IndexError, RecursionError):
        return finding.value


def answers_apart(a: str, b: str, width: int) -> tuple[str, str]:
    """Return two different answers, printable, in at most ``width`` characters in which they
    differ."""
    a, b = printable(a), printable(b)
    at = next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), 0)
    if max(len(a), len(b)) > width and at > width - _BEFORE:
        a, b = (f"…{text[at - _BEFORE :]}" for text in (a, b))
    return shortened(a, width), shortened(b, width)


def _exit_text(value: Any) -> str:
    status = os.waitstatus_to_exitcode(int(value["tuple"][1]))
    return f"exit status {status}" if status >= 0 else f"ended by signal {-status}"


def _text(value: Any) -> str:
    return str(_Shown(value)) if isinstance(value, (dict, list)) else repr(value)


class _Shown:
    """A decoded value whose ``repr`` is that of the answer itself."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def __repr__(self) -> str:
        value = self._value
        if isinstance(value, list):
            return repr([_Shown(item) for item in value])
        if isinstance(value, dict) and "bytes" in value:
            return repr(base64.b64decode(value["bytes"], validate=True))
        if isinstance(value, dict) and "tuple" in value:
            return repr(tuple(_Shown(item) for item in value["tuple"]))
        if isinstance(value, dict) and "error" in value:
            kind, _, text, *_ = value["error"]
            return f"{kind}: {text}"
        return repr(value)
