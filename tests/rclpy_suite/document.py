"""The document that states how much of rclpy's test suite runs, and why the rest does not."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass

_TEXT = """# rclpy's own tests on rsltrace

Made by `python tests/rclpy_suite --rclpy PATH --baseline LIST --document VERSION`, which runs
rclpy's test suite on rsltrace's middleware, from a checkout of rclpy (none of its code is kept
here). Each test module is the `main:` of a job with
`clocks: {{source: topic, advances: true}}`; wherever a test spins, sleeps, waits or starts a
thread, simulated time passes. `make rclpy-tests RCLPY=PATH` does it without the document.

| rclpy {version} | tests |
|---|---|
| in the suite | {suite} |
| of these, pass natively over DDS three times in a row | {native} |
| pass in the simulation | {passed} |
| of those that pass natively, pass in the simulation | {both} |
| excluded, with the reasons below | {excluded} |
| fail | {failed} |

(Some tests are too sensitive to load to pass natively three times in a row; in simulated time they
pass.)

## What is excluded, and why

| test | reason |
|---|---|
{rows}
"""


@dataclass(frozen=True)
class Counts:
    """What a run of the suite came to."""

    version: str
    suite: int
    native: int
    passed: int
    both: int
    excluded: int
    failed: int


def document(counts: Counts, excluded: Mapping[str, str]) -> str:
    """Return the document."""
    rows = "\n".join(
        f"| `{test.removeprefix('test/')}` | {reason} |" for test, reason in excluded.items()
    )
    return _TEXT.format(rows=rows, **asdict(counts))


def counts_in(text: str) -> Counts:
    """Read the counts back from a document."""
    version = re.search(r"^\| rclpy (.*) \| tests \|$", text, re.MULTILINE)
    assert version is not None
    head = text.partition("## ")[0]
    numbers = [int(number) for number in re.findall(r"^\|.*\| (\d+) \|$", head, re.MULTILINE)]
    return Counts(version[1], *numbers)
