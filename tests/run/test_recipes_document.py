"""docs/recipes.md is run as it stands: its files are written, its commands give what it shows.

``...`` stands for any lines, ``…`` for any text within a line; spaces count once.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.long]
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

DOCUMENT = Path(__file__).parents[2] / "docs" / "recipes.md"
_BLOCK = re.compile(r"<!-- (file: (?P<name>\S+)|run) -->\n```\w+\n(?P<text>.*?)^```", re.M | re.S)


def blocks(text: str) -> Iterator[tuple[str | None, str]]:
    """Yield (name of a file or None, text) of what is marked, in order."""
    for match in _BLOCK.finditer(text):
        yield match["name"], match["text"]


def commands(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield each command of a console block with the lines that it is to print."""
    for part in re.split(r"^\$ ", text, flags=re.M)[1:]:
        command, *expected = part.rstrip("\n").split("\n")
        yield command, expected


def pattern(expected: list[str]) -> str:
    """Return the regular expression that a command's lines are to match as a whole."""
    rows = []
    for row in expected:
        if row == "...":
            rows.append(r"(?:.*\n)*?")
            continue
        words = " ".join(row.split())
        rows.append(re.escape(words).replace("…", r".*") + r"\n")
    return "".join(rows)


def shown(output: str) -> str:
    return "".join(f"{' '.join(row.split())}\n" for row in output.rstrip("\n").split("\n"))


def test_every_command_does_what_it_shows(tmp_path: Path) -> None:
    bin_folder = os.path.dirname(sys.executable)
    environment = {
        **os.environ,
        "PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}",
        "PYTEST_ADDOPTS": "-p no:cacheprovider",
        "COLUMNS": "100",
    }
    ran = 0
    for name, text in blocks(DOCUMENT.read_text("utf-8")):
        if name is not None:
            (tmp_path / name).write_text(text)
            continue
        for command, expected in commands(text):
            done = subprocess.run(
                ["bash", "-c", command],
                cwd=tmp_path,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=1800,
                check=False,
            )
            ran += 1
            output = shown(done.stdout) if done.stdout else ""
            assert re.fullmatch(pattern(expected), output), f"$ {command}\n{done.stdout}"
    assert ran > 10
