"""What the documents show is run as it stands: files are written, commands give what is shown.

``<!-- file: NAME -->`` stands before a file's text, ``<!-- run -->`` before commands with what they
print, ``<!-- run: DATA -->`` before those that need ``shared/data/DATA`` beside the checkout, and
are left out without it; ``<!-- setup … -->`` holds commands that a reader does not see. In what is
shown, ``...`` stands for any lines, ``…`` for any text within a line; spaces count once.

What follows a debugger's prompt is typed there, unless ``-c`` says it. A block that begins with
such a prompt goes on in the session of the block before it.
"""

from __future__ import annotations

import difflib
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests import golden_files

pytestmark = [pytest.mark.ros, pytest.mark.long]
pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
DOCUMENTS = sorted(
    path
    for path in (ROOT / "README.md", *ROOT.glob("docs/**/*.md"))
    if "<!-- run" in path.read_text("utf-8")
)
_BLOCK = re.compile(
    r"<!-- (?:(?:file: (?P<name>\S+)|run(?:: (?P<data>\S+))?) -->\n```\w+\n(?P<text>.*?)^```"
    r"|setup\n(?P<setup>.*?)^-->)",
    re.M | re.S,
)
_PROMPT = re.compile(r"\((?:rsltrace|Pdb)\) (.*)")


@dataclass
class Step:
    """A command with the lines that it is to print, or (None) one that a reader does not see."""

    command: str
    expected: list[str] | None = None
    data: str | None = None

    @property
    def typed(self) -> str:
        """What is typed while it runs."""
        if self.expected is None or " -c " in self.command:
            return ""
        typed = filter(None, map(_PROMPT.fullmatch, self.expected))
        return "".join(f"{line[1]}\n" for line in typed)


def steps(text: str) -> list[Step]:
    """Return what a document has done, in order."""
    found: list[Step] = []
    for block in _BLOCK.finditer(text):
        if block["setup"]:
            found.append(Step(f"set -e\n{block['setup']}"))
        elif block["name"]:
            end = "END-OF-FILE"
            found.append(Step(f"cat > {block['name']} <<'{end}'\n{block['text']}{end}"))
        else:
            before, *parts = re.split(r"^\$ ", block["text"].rstrip("\n"), flags=re.M)
            if before:
                assert found[-1].expected is not None, f"no session before: {before}"
                found[-1].expected += before.rstrip("\n").split("\n")
            for command, *expected in (part.rstrip("\n").split("\n") for part in parts):
                found.append(Step(command, expected, block["data"]))
    return found


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


def console(command: str, folder: Path, typed: str = "") -> str:
    environment = {
        **os.environ,
        "PATH": f"{os.path.dirname(sys.executable)}{os.pathsep}{os.environ['PATH']}",
        "PYTEST_ADDOPTS": "-p no:cacheprovider",
        "COLUMNS": "100",
        "ROOT": str(ROOT),
    }
    environment.pop("PYTHONHASHSEED", None)
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=environment,
        input=typed,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=1800,
        check=False,
    )
    return done.stdout


def renewed(step: Step, now: list[str]) -> list[str]:
    """Return what a document is to show, where lines that still match stay as they are."""
    expected = step.expected or []
    ahead, same = 0, {}
    for place, line in enumerate(expected):
        found = next((n for n in range(ahead, len(now)) if _matches(line, now[n])), None)
        if line != "..." and found is not None:
            same[place], ahead = found, found + 1
    lines: list[str] = []
    ahead, skips = 0, False
    gap: list[str] = []
    for place, line in enumerate([*expected, ""]):
        if line == "...":
            lines.append(line)
            skips = True
        elif place in same or place == len(expected):
            until = same.get(place, len(now))
            if skips:
                for old in gap:
                    lines += difflib.get_close_matches(old, now[ahead:until], 1, 0.0)
                lines += ["..."] * bool(gap)
            else:
                lines += now[ahead:until]
            lines += [line] * (place in same)
            ahead, gap, skips = until + 1, [], False
        else:
            gap.append(line)
    return lines


def _matches(line: str, printed: str) -> bool:
    return re.fullmatch(pattern([line]), shown(printed)) is not None


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_command_does_what_it_shows(document: Path, tmp_path: Path) -> None:
    ran = 0
    for step in steps(document.read_text("utf-8")):
        if step.data is not None and not (DATA / step.data).exists():
            continue
        printed = console(step.command, tmp_path, step.typed)
        if step.expected is not None:
            ran += 1
            output = shown(printed) if printed else ""
            if golden_files.update and not re.fullmatch(pattern(step.expected), output):
                now = printed.replace(str(tmp_path), "…").splitlines()
                text = document.read_text("utf-8")
                old, new = ("\n".join(lines) for lines in (step.expected, renewed(step, now)))
                assert text.count(old) == 1, old
                document.write_text(text.replace(old, new), "utf-8")
                continue
            assert re.fullmatch(pattern(step.expected), output), f"$ {step.command}\n{printed}"
    assert ran


def test_the_documents_that_show_results_are_run() -> None:
    names = {path.name for path in DOCUMENTS}
    assert names >= {"README.md", "debugging.md", "what-if.md", "verify.md"}
    assert names >= {"index.md", "flaky-node.md", "golden-traces.md", "debug-an-event.md"}
    assert names >= {"audit.md", "guard.md", "launch.md", "bisect.md", "one-node.md"}


def test_a_line_that_is_stale_is_noticed() -> None:
    assert re.fullmatch(pattern(["...", "digest 12"]), "x\ndigest 12\n")
    assert not re.fullmatch(pattern(["...", "digest 12"]), "x\ndigest 13\n")
    assert not re.fullmatch(pattern(["(/speed)."]), "(/speed: data 1 → 2).\n")
