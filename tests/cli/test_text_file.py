"""Files that a command writes as a whole."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rsltrace.cli.output.text_file import write_text
from rsltrace.errors import OutputError

SAMPLE = Path(__file__).parents[2] / "sample_traces" / "nondeterministic_callback"


def test_a_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "report.txt"
    write_text(path, "first")
    path.chmod(0o600)
    write_text(path, "second")
    assert path.read_text() == "second"
    assert path.stat().st_mode & 0o777 == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_is_followed_and_a_pipe_is_written_to(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "report.txt")
    write_text(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "report.txt").read_text() == "text"
    reading, writing = os.pipe()
    write_text(Path(f"/dev/fd/{writing}"), "text")
    os.close(writing)
    with os.fdopen(reading) as pipe:
        assert pipe.read() == "text"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="Linux has /dev/full")
def test_a_device_that_is_full_is_named() -> None:
    with pytest.raises(OutputError, match="/dev/full cannot be written: No space left on device"):
        write_text(Path("/dev/full"), "text")


@pytest.mark.parametrize("there", [False, True])
def test_a_report_on_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path, there: bool) -> None:
    if there:
        (tmp_path / "report.md").write_text("old")
    code = (
        "import resource, sys\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50, 50))\n"
        "from rsltrace.cli.main import main\nmain(sys.argv[1:])\n"
    )
    command = [sys.executable, "-c", code, "diff", str(SAMPLE / "a.mcap"), str(SAMPLE / "b.mcap")]
    done = subprocess.run(
        [*command, "--format", "markdown", "-o", "report.md"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 2, "1 would say that they part"
    assert done.stderr == "rsltrace: error: report.md cannot be written: File too large\n"
    assert [path.name for path in tmp_path.iterdir()] == (["report.md"] if there else [])
    if there:
        assert (tmp_path / "report.md").read_text() == "old"
