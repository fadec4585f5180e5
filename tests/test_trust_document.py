"""docs/trust.md: each promise names a test that is there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_promise_is_held_by_a_test() -> None:
    promises = (ROOT / "docs/trust.md").read_text().partition("## Recording")[2]
    rows = re.findall(r"^\| (?!promise|text|---)(.*) \| (.*) \|$", promises, re.M)
    assert rows
    for promise, held_by in rows:
        file = ""
        tests = re.findall(r"`([^`]*)`", held_by)
        assert tests, promise
        for test in tests:
            path, _, name = test.partition("::")
            file = file if path == "…" else path
            assert f"def {name}" in (ROOT / file).read_text(), test
