"""The document that states how much of rclpy's test suite runs, and why the rest does not."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass

_TEXT = """# rclpy's own tests on rsltrace

Made by `python campaigns/rclpy_suite --rclpy PATH --baseline LIST --document VERSION`, once with
`--processes` and once without, from a checkout of rclpy:

- **here**: each module is the `main:` of a job with `clocks: {{source: topic, advances: true}}`
  and [`policy: rclpy`](../policies.md);
- **process**: each is an `isolated: true` script with `clocks: {{source: topic}}`, with rclpy's
  compiled parts on [the library of processes](../processes.md).

| rclpy {version} | here | process |
|---|---|---|
{counts}

## What is excluded, and why

| test | where | reason |
|---|---|---|
{rows}
"""
_WAYS = {"simulation": "here", "process": "process"}
_LINES = {
    "suite": "in the suite",
    "native": "of these, pass natively over DDS three times in a row",
    "passed": "pass in the simulation",
    "both": "of those that pass natively, pass in the simulation",
    "excluded": "excluded, with the reasons below",
    "failed": "fail",
}


@dataclass(frozen=True)
class Counts:
    """What a run of the suite came to."""

    suite: int
    native: int
    passed: int
    both: int
    excluded: int
    failed: int


def document(
    version: str, counts: Mapping[str, Counts], excluded: Mapping[str, Mapping[str, str]]
) -> str:
    """Return the document, of counts and excluded tests by where the tests have run."""
    lines = [
        f"| {text} | " + " | ".join(str(asdict(counts[way])[name]) for way in _WAYS) + " |"
        for name, text in _LINES.items()
    ]
    rows = [
        f"| `{test.removeprefix('test/')}` | {where} | {reason} |"
        for way, where in _WAYS.items()
        for test, reason in excluded[way].items()
    ]
    return _TEXT.format(version=version, counts="\n".join(lines), rows="\n".join(rows))


def read(text: str) -> tuple[str, dict[str, Counts]]:
    """Read the version and the counts back from a document."""
    version = re.search(r"^\| rclpy (.*) \| here \| process \|$", text, re.MULTILINE)
    assert version is not None
    found = re.findall(r"^\|.*\| (\d+) \| (\d+) \|$", text, re.MULTILINE)
    columns = zip(*([int(cell) for cell in line] for line in found), strict=True)
    return version[1], dict(zip(_WAYS, (Counts(*column) for column in columns), strict=True))
