"""The manual pages (``tests/test_documents.py`` has them current) are ones for roff."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MAN = ROOT / "man"


@pytest.mark.skipif(shutil.which("groff") is None, reason="needs groff")
def test_the_pages_can_be_set() -> None:
    command = ["groff", "-man", "-Tutf8", "-ww", "-W", "break", "-P-c", "-P-u", "-P-b", "-P-o"]
    pages = [*map(str, sorted(MAN.glob("*.1")))]
    done = subprocess.run(
        [*command, *pages], capture_output=True, text=True, timeout=300, check=True
    )
    assert done.stderr == ""
    assert "--allow-truncated" in done.stdout
