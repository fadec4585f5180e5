"""The kernels of numerical libraries are told of mains that import them when they run, too."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rsltrace.run import provenance
from rsltrace.trace.reader import Trace

_MAIN = """
import rclpy
def main():
    rclpy.init()
    node = rclpy.create_node("n")
    {imports}
    node.get_logger().info("done")
"""
_JOB = "nodes: [{{{entry}}}]\nstop: {{time: 1s}}\n"


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("entry", "imports", "found"),
    [
        ("main: 'm:main'", "import late_numbers", True),
        ("main: 'm:main'", "import late_words", False),
        ("main: 'm:main'", "import late_tests", True),
        ("script: m.py", "import numpy", True),
        ("script: m.py", "import json", False),
    ],
)
def test_libraries_that_a_run_imports_are_named(
    command: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    entry: str,
    imports: str,
    found: bool,
) -> None:
    (tmp_path / "late_numbers.py").write_text("from numpy.linalg import solve\n")
    (tmp_path / "late_words.py").write_text("import json\n")
    (tmp_path / "late_tests.py").write_text(
        "class Tests:\n    def test(self):\n        import numpy as np\n"
    )
    code = _MAIN.format(imports=imports) + "if __name__ == '__main__':\n    main()\n"
    (tmp_path / "m.py").write_text(code)
    (tmp_path / "job.yaml").write_text(_JOB.format(entry=entry))
    for name in ("SkylakeX", "Haswell"):
        monkeypatch.setattr(provenance, "_kernels", lambda name=name: f"openblas {name}")
        assert command("record", "job.yaml", "-o", f"{name}.mcap").returncode == 0
        (tmp_path / "m.py").write_text(code.replace("done", "done otherwise"))
        for module in ("late_numbers", "late_words", "late_tests", "m"):
            sys.modules.pop(module, None)
    with Trace.open(tmp_path / "SkylakeX.mcap") as trace:
        assert trace.environment.get("numerics") == ("openblas SkylakeX" if found else None)
    said = command("diff", "SkylakeX.mcap", "Haswell.mcap").stdout
    assert ("openblas SkylakeX" in said and "openblas Haswell" in said) is found
