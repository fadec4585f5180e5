"""The complete example of ``docs/simulation.md`` runs as printed there, the same each time."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros

DOCUMENT = Path(__file__).parents[2] / "docs" / "simulation.md"
MARK = "<!-- tested: tests/run/test_simulation_document.py -->\n```python\n"


@pytest.mark.long
def test_the_gym_like_example_reaches_its_goal(tmp_path: Path) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    code = text.split(MARK)[1].split("```")[0]
    (tmp_path / "example.py").write_text(code, encoding="utf-8")
    printed = [
        subprocess.run(
            [sys.executable, "example.py"],
            cwd=tmp_path,
            env={"PYTHONHASHSEED": seed, "HOME": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
            timeout=300,
        ).stdout
        for seed in ("1", "2")
    ]
    assert printed[0] == printed[1]
    assert re.fullmatch(r"x 0\.98\d after \d\.\d\d s, digest [0-9a-f]{16}\n", printed[0]), printed
    assert (tmp_path / "episode.mcap").exists()
