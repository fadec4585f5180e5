"""The one oracle: a named error or the right answer, within bounds, nothing raw, nothing executed.

It knows what every command owes to everybody. What is the right answer for a case (equal content,
a file that must be there) is the case's own ``judge``.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from campaigns.attack.model import Case, Command, Complaint, Limits, Ran, Wrong

OK = 0
DIFFERENT = 1
USAGE = 2
RUN = 3
INTERRUPTED = frozenset((129, 130, 143))
"""128 + SIGHUP, SIGINT, SIGTERM."""

READING = frozenset((OK, USAGE))
COMPARING = frozenset((OK, DIFFERENT, USAGE, RUN))
RECORDING = frozenset((OK, USAGE, RUN))

_RAW = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Control characters other than tab and newline, and what turns the direction of text around."""

_TRACEBACK = "Traceback (most recent call last)"
_PACKAGES = "|".join(
    re.escape(str(Path(str(spec.origin)).parent))
    for spec in map(find_spec, ("rsltrace", "rsltrace_viewer"))
    if spec is not None
)
_OURS = re.compile(rf'^\s*File "(?:{_PACKAGES})/[^"\n]*\.py"', re.MULTILINE)
_OF_TOPIC = re.compile(r"messages? on /\S+ ")
_ERROR = re.compile(r"error", re.IGNORECASE)
_CPU_SIGNALS = (signal.SIGXCPU, signal.SIGKILL)


def judge(case: Case, runs: Sequence[Ran]) -> list[Complaint]:
    """Return everything that is wrong with what a case came to."""
    found: list[Complaint] = []
    for ran in runs:
        found += [
            Complaint(complaint.wrong, complaint.text, ran.line)
            for complaint in _judge_run(case, ran)
        ]
    if case.canary.exists():
        text = case.canary.read_text(errors="replace")[:200]
        found.append(Complaint(Wrong.EXECUTED, f"code ran that must not: {text!r}"))
    if case.judge is not None:
        found += case.judge(runs)
    return found


def _judge_run(case: Case, ran: Ran) -> list[Complaint]:
    limits = ran.command.limits
    found: list[Complaint] = []
    if ran.timed_out:
        found.append(Complaint(Wrong.HANG, f"no end after {ran.wall_s:.0f} s"))
    elif ran.cpu_s > limits.cpu_s or (-ran.status in _CPU_SIGNALS and ran.cpu_s > limits.cpu_s):
        found.append(Complaint(Wrong.CPU, f"{ran.cpu_s:.1f} s of CPU, limit {limits.cpu_s:g} s"))
    elif ran.status < 0 and ran.status not in ran.command.allowed and not _was_killed(ran):
        found.append(Complaint(Wrong.DIED, f"of {signal.Signals(-ran.status).name}"))
    elif ran.status >= 0 and ran.status not in ran.command.allowed:
        found.append(Complaint(Wrong.STATUS, f"{ran.status}: {_tail(ran.stderr)}"))
    if ran.rss_mib > limits.rss_mib:
        found.append(Complaint(Wrong.MEMORY, f"{ran.rss_mib:.0f} MiB, limit {limits.rss_mib}"))
    if ran.left:
        found.append(Complaint(Wrong.LEFT, f"{ran.left} processes go on after it"))
    for name, data in (("stdout", ran.stdout), ("stderr", ran.stderr)):
        text = data.decode("utf-8", "replace")
        found += _judge_text(case, name, text)
    if _says_nothing(case, ran):
        found.append(Complaint(Wrong.UNNAMED, f"{ran.status}: {_tail(ran.stderr)}"))
    return found


def _judge_text(case: Case, name: str, text: str) -> list[Complaint]:
    found = []
    raw = _RAW.search(text)
    if raw is not None:
        around = text[max(raw.start() - 60, 0) : raw.end() + 40]
        found.append(Complaint(Wrong.RAW, f"{name}: {around!r}"))
    if name == "stderr" and _TRACEBACK in text and (not case.user_code or _OURS.search(text)):
        found.append(Complaint(Wrong.TRACEBACK, _tail(text.encode(), lines=6)))
    if "MemoryError" in text and not case.user_code:
        found.append(Complaint(Wrong.MEMORY, f"{name}: {_tail(text.encode())}"))
    for secret in case.secrets:
        if secret in text:
            at = text.index(secret)
            around = text[max(at - 60, 0) : at + 40]
            found.append(Complaint(Wrong.SECRET, f"{name}: {around!r}"))
            break
    return found


def _says_nothing(case: Case, ran: Ran) -> bool:
    """Whether it failed without a line that says so and names what it is about."""
    if ran.status not in (USAGE, RUN) or ran.command.stderr != "file":
        return False
    if ran.status == RUN and ran.command.words[0] == "diff":  # within tolerance
        return False
    text = ran.stderr.decode("utf-8", "replace")
    if _TRACEBACK in text and not case.user_code:
        return False  # blamed already
    named = any(name in text for name in case.names)
    if ran.command.words[0] != "diff":  # no doubt which file's topic it is
        named = named or _OF_TOPIC.search(text) is not None
    return not (_ERROR.search(text) and named)


def _was_killed(ran: Ran) -> bool:
    return ran.killed and ran.command.kill is not None and -ran.status == ran.command.kill.signal


def _tail(data: bytes, lines: int = 2) -> str:
    text = data.decode("utf-8", "replace").strip()
    return " / ".join(text.splitlines()[-lines:])[-600:]


def reading(*words: str, cwd: Path, limits: Limits = Limits(), **more: object) -> Command:  # noqa: B008
    """Return a command that reads: it ends with 0 or 2, or, if it compares, with 1 or 3, too."""
    allowed = COMPARING if words[0] == "diff" else READING
    if words[0] == "export":
        allowed |= {DIFFERENT}  # of a trace that is cut
    return Command(tuple(words), allowed, cwd, limits=limits, **more)  # type: ignore[arg-type]
