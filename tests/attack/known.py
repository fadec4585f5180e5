"""What gives way today, each with the item of the trust issue that will mend it.

It shrinks to nothing: the test fails when an entry no longer shows in the slice of ``make test``.
A key is ``family/attack: what was wrong``.
"""

from __future__ import annotations

KNOWN: dict[str, str] = {}
