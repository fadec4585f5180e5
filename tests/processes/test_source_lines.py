"""Which lines of programs are shown as their own code."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.adapters.processes.build import find_compiler
from rsltrace.adapters.processes.source_lines import callback_place
from rsltrace.errors import SetupError


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("node", "node.c:2"),
        ("python_bridge", "node.c:2"),
        ("python3.11", ""),
        ("libpython3.13t.so.1.0", ""),
        ("lib-dynload/_random.so", ""),
    ],
)
def test_lines_of_an_interpreter_are_not_those_of_its_program(
    tmp_path: Path, name: str, place: str
) -> None:
    try:
        compiler = find_compiler()
    except SetupError as error:
        pytest.skip(str(error))
    source, program = tmp_path / "node.c", tmp_path / name
    program.parent.mkdir(exist_ok=True)
    source.write_text("\nint main(void) { return 0; }\n")
    subprocess.run([*compiler, "-g", "-x", "c", str(source), "-o", str(program)], check=True)
    assert callback_place("main", [(str(program), 0)]) == place
