"""``rsltrace replay`` as it is typed: positions, reports, exit statuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import rsltrace
from rsltrace.cli.main import cli
from rsltrace.errors import ReplayError
from rsltrace.trace.reader import Trace
from tests.replay.conftest import NODES

pytestmark = pytest.mark.ros


@pytest.fixture
def command(
    recorded: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """Record a job in the present folder; what the command prints and returns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rsltrace.cli.replay.unpin", lambda: None)
    recorded()

    def go(*words: str) -> Any:
        return CliRunner().invoke(cli, ["replay", "run.mcap", *words])

    return go


def test_what_is_said(command: Callable[..., Any]) -> None:
    done = command()
    assert done.exit_code == 0
    assert done.stderr.startswith("replaying run.mcap: ")
    assert "  nodes_of_replay  nodes_of_replay.py\n" in done.stderr
    assert "not as it was" not in done.stderr
    with Trace.open("run.mcap") as trace:
        assert done.stdout == (
            f"verified all {trace.event_count} events, to 3.000000000 s (duration of 3.000000000 "
            f"s)\ndigest {trace.digest}  events {trace.event_count}  sim 3.000000000\n"
        )


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("until", "verified", "stamp"),
    [("0", 1, "0.000000000"), ("12", 13, "0.400000000"), ("0.4", 15, "0.4"), ("400ms", 15, "0.4")],
)
def test_until(command: Callable[..., Any], until: str, verified: int, stamp: str) -> None:
    done = command("--until", until)
    assert done.exit_code == 0
    assert f"verified the first {verified} events of " in done.stdout
    assert f"to {stamp}" in done.stdout
    assert rsltrace.replay("run.mcap", until=until).verified == verified


def test_until_keeps_a_prefix(command: Callable[..., Any]) -> None:
    command("--until", "20", "-o", "prefix.mcap")
    with Trace.open("run.mcap") as whole, Trace.open("prefix.mcap") as prefix:
        assert prefix.event_count == 21
        assert all(whole.event(i) == prefix.event(i) for i in range(21))


def test_positions_that_are_none(command: Callable[..., Any]) -> None:
    with pytest.raises(ReplayError, match="neither the index of an event"):
        rsltrace.replay("run.mcap", until="soon")
    for option in ("--until", "--from"):
        assert f"error: {option}: 'soon' is neither the index" in command(option, "soon").stderr
    assert command("--until", "1000000").stdout.startswith("verified all ")


@pytest.mark.long
def test_log_records_begin_where_they_are_wanted(command: Callable[..., Any]) -> None:
    everything, late = command(), command("--from", "2.5")
    told = [line for line in late.stderr.splitlines() if "too fast" in line]
    assert 0 < len(told) < sum("too fast" in line for line in everything.stderr.splitlines())
    assert "too fast" not in command("-q").stderr


@pytest.mark.long
def test_a_divergence_is_told_as_by_diff(command: Callable[..., Any], tmp_path: Path) -> None:
    code = NODES.replace("0.125", "0.126")
    (tmp_path / "nodes_of_replay.py").write_text(code)
    done = command()
    assert done.exit_code == 1
    assert "  nodes_of_replay  nodes_of_replay.py  (has changed)\n" in done.stderr
    assert "verdict: same-input-different-output; the first 4 events agree" in done.stdout
    assert "data  0.28125  |  0.2835  |a-b| 0.00225" in done.stdout
    assert "settings that differ: code of module nodes_of_replay" in done.stdout
    assert done.stdout.endswith(
        "\nnext: rsltrace replay run.mcap -o replay.mcap; rsltrace view run.mcap replay.mcap\n"
    )
    values = json.loads(command("--json", "-o", "other.mcap").stdout)
    assert (values["diverged_at"], values["verified"], values["exit_code"]) == (4, 4, 1)
    assert values["diff"]["divergences"][0]["a"]["index"] == 4
    assert values["code"] == [
        {
            "name": "nodes_of_replay",
            "file": str(tmp_path / "nodes_of_replay.py"),
            "change": "has changed",
        }
    ]
    assert Path("other.mcap").exists()


@pytest.mark.long
def test_trouble_is_2(command: Callable[..., Any], tmp_path: Path) -> None:
    import subprocess
    import sys

    (tmp_path / "nodes_of_replay.py").unlink()
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", "replay", "run.mcap"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "  nodes_of_replay  -  (is not here)\n" in done.stderr
    assert "there is no module 'nodes_of_replay'" in done.stderr


def test_the_trace_itself_is_never_written_over(command: Callable[..., Any]) -> None:
    before = Path("run.mcap").read_bytes()
    assert command("-o", "run.mcap", "--force").exit_code != 0
    assert Path("run.mcap").read_bytes() == before


def test_what_a_trace_says_cannot_steer_a_terminal(
    command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "run\x1b[31m.mcap"
    Path("run.mcap").rename(name)
    done = CliRunner().invoke(cli, ["replay", name])
    assert "\x1b" not in done.output
