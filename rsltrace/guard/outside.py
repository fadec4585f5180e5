"""Values that came from outside of a run: kept in the trace, and given again in a re-run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rsltrace.model.finding import Source


class Outside:
    """Takes the real answers of recorded sources."""

    def __call__(self, source: Source, call: str, real: Callable[[], Any]) -> Any:
        """Return the real answer."""
        return real()
