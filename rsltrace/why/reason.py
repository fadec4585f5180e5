"""What all reasons have."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from rsltrace.trace.words.phrases import seconds_text
from rsltrace.why.question import Question


@dataclass(frozen=True, kw_only=True)
class Reason:
    """Why a callback did not run. Times are simulated nanoseconds; entities are named as in
    sentences.

    ``place`` is the line of code (``module.py:24``) of what is to blame, ``event`` the one to look
    at; "" and None if unknown.
    """

    is_reason: ClassVar[bool] = True
    """Whether something kept the callback from running; else another reason is looked for."""
    question: Question
    place: str = ""
    event: int | None = None

    @property
    def kind(self) -> str:
        """What programs call it: ``pushed_out``."""
        return re.sub("(?<=[a-z])(?=[A-Z])", "_", type(self).__name__).lower()

    @classmethod
    def find(cls, question: Question) -> Reason | None:
        """Return the reason, None if it does not hold."""
        raise NotImplementedError

    def seconds(self, stamp_ns: int) -> str:
        """Return a time in seconds since the start of the run: ``1.5``."""
        return seconds_text(self.question.history.trace.stamp(stamp_ns))

    def when(self, stamp_ns: int) -> str:
        """Return a time as part of a sentence: ``at 1.5 s``."""
        return f"at {self.seconds(stamp_ns)} s"

    def words(self) -> str:
        """Return a sentence without its full stop."""
        raise NotImplementedError

    def clause(self) -> str:
        """Return the reason as what follows "because" in the sentence of another one."""
        return self.words()

    def because(self) -> Reason | None:
        """Return the reason behind this one, if there is one."""
        return None

    def evidence(self) -> Iterator[str]:
        """Yield lines that show what the trace says, beside the counts and the event."""
        yield from ()
