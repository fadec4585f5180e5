"""The manual pages are those of the commands, and roff has nothing to say about them."""

from __future__ import annotations

import runpy
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MAN = ROOT / "man"


def test_the_pages_are_current() -> None:
    pages = runpy.run_path(str(ROOT / "docs" / "make_man_pages.py"))["pages"]()
    assert {path.name: path.read_text("utf-8") for path in MAN.glob("*.1")} == pages, "make docs"
    assert "rsltrace\\-explore\\fR(1)" in pages["rsltrace.1"]


@pytest.mark.skipif(shutil.which("groff") is None, reason="needs groff")
def test_the_pages_can_be_set() -> None:
    command = ["groff", "-man", "-Tutf8", "-ww", "-W", "break", "-P-c", "-P-u", "-P-b", "-P-o"]
    pages = [*map(str, sorted(MAN.glob("*.1")))]
    done = subprocess.run(
        [*command, *pages], capture_output=True, text=True, timeout=300, check=True
    )
    assert done.stderr == ""
    assert "--as-far-as-they-go" in done.stdout
