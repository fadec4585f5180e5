"""Which files of this machine a trace can have shown by the places of its source code."""

from __future__ import annotations

from pathlib import Path

import pytest
from trace_maker import write_run

from rsltrace.trace.reader import Trace
from rsltrace.trace.words.code import code_file


def test_a_place_is_a_file_below_the_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "job"
    folder.mkdir()
    monkeypatch.chdir(folder)
    write_run(folder / "run.mcap", 3)
    for file in (folder / "node.py", tmp_path / "secret.py"):
        file.write_text("")
    with Trace.open("run.mcap") as trace:
        assert code_file(trace, "node.py:7") == (Path("node.py"), 7)
        for place in ("../secret.py:1", f"{tmp_path}/secret.py:1", "job/../../secret.py:1"):
            assert code_file(trace, place) is None
