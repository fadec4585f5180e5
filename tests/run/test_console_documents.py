"""What the documents show is run as it stands: files are written, commands give what is shown.

``<!-- file: NAME -->`` stands before a file's text, ``<!-- run -->`` before commands with what they
print, ``<!-- setup … -->`` holds commands that a reader does not see. In what is shown, ``...``
stands for any lines, ``…`` for any text within a line; spaces count once.
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

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted(
    path
    for path in (ROOT / "README.md", *ROOT.glob("docs/*.md"))
    if "<!-- run -->" in path.read_text("utf-8")
)
_BLOCK = re.compile(
    r"<!-- (?:(?:file: (?P<name>\S+)|run) -->\n```\w+\n(?P<text>.*?)^```"
    r"|setup\n(?P<setup>.*?)^-->)",
    re.M | re.S,
)


def blocks(text: str) -> Iterator[re.Match[str]]:
    """Yield what is marked, in order."""
    return _BLOCK.finditer(text)


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


def console(command: str, folder: Path) -> str:
    environment = {
        **os.environ,
        "PATH": f"{os.path.dirname(sys.executable)}{os.pathsep}{os.environ['PATH']}",
        "PYTEST_ADDOPTS": "-p no:cacheprovider",
        "COLUMNS": "100",
        "ROOT": str(ROOT),
    }
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=1800,
        check=False,
    )
    return done.stdout


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_command_does_what_it_shows(document: Path, tmp_path: Path) -> None:
    ran = 0
    for block in blocks(document.read_text("utf-8")):
        if block["setup"]:
            console(f"set -e\n{block['setup']}", tmp_path)
        elif block["name"]:
            (tmp_path / block["name"]).write_text(block["text"])
        else:
            for command, expected in commands(block["text"]):
                printed = console(command, tmp_path)
                ran += 1
                output = shown(printed) if printed else ""
                assert re.fullmatch(pattern(expected), output), f"$ {command}\n{printed}"
    assert ran


def test_the_documents_that_show_results_are_run() -> None:
    names = {path.name for path in DOCUMENTS}
    assert names >= {"README.md", "recipes.md", "debugging.md", "what-if.md", "verify.md"}
    assert names >= {"audit.md", "guard.md", "launch.md"}


def test_a_line_that_is_stale_is_noticed() -> None:
    assert re.fullmatch(pattern(["...", "digest 12"]), "x\ndigest 12\n")
    assert not re.fullmatch(pattern(["...", "digest 12"]), "x\ndigest 13\n")
    assert not re.fullmatch(pattern(["(/speed)."]), "(/speed: data 1 → 2).\n")
