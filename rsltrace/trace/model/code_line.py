"""A place in user code, as far as a run has met it: where outputs come from, what callbacks run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CodeLine:
    """``place`` is ``package/module.py:24``, ``function`` the name of the function it is in.

    ``event`` is the first, of the callback that ran in it, from which output number ``output`` of
    ``entity`` came from there; with ``NO_SEQUENCE`` as output, the first event of ``entity`` that
    ran the function defined there. Without a place, it says that what the same callback sends
    through ``entity`` after that output is looked at now and then only.
    """

    event: int
    entity: int
    output: int
    place: str
    function: str
