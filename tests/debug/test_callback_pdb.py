"""``pdb`` in the first line of a callback, over a socket."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from rsltrace.debug.callback_pdb import call_under_pdb
from rsltrace.debug.prompt.pdb_terminal import talk
from rsltrace.errors import DebugError


def callback(message: int) -> int:
    doubled = 2 * message
    helped = helper(doubled)
    if message < 0:
        raise ValueError(f"negative: {message}")
    return helped


def helper(value: int) -> int:
    return value + 1


def conversation(
    lines: Sequence[str], message: int, capsys: pytest.CaptureFixture[str]
) -> tuple[str, list[str], str]:
    """Return what the callback raised, the prompts at which lines were read, what was shown."""
    left, prompts = list(lines), []

    def read(prompt: str) -> str | None:
        prompts.append(prompt)
        return left.pop(0) if left else None

    raised = talk(lambda address: call_under_pdb(callback, (message,), address), read)
    return raised, prompts, capsys.readouterr().out


def test_it_stops_in_the_first_line_and_steps(capsys: pytest.CaptureFixture[str]) -> None:
    lines = ["p message", "n", "p doubled", "s", "s", "w", "c"]
    raised, prompts, shown = conversation(lines, 21, capsys)
    assert raised == ""
    assert prompts == ["(Pdb) "] * len(lines)
    begin = shown.splitlines()
    assert begin[0].endswith("callback()")
    assert begin[1] == "-> doubled = 2 * message"
    assert begin[2] == "21"
    assert "42" in begin
    assert "-> return value + 1" in begin


@pytest.mark.parametrize("line", ["q", "exit", "EOF"])
def test_ending_pdb_ends_the_callback(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert conversation([line], 1, capsys)[0] == ""
    assert conversation([], 1, capsys)[1] == ["(Pdb) "], "a script that is over ends it, too"


def test_what_the_callback_raises_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert conversation(["c"], -1, capsys)[0] == "ValueError: negative: -1"


def test_what_a_user_types_wrong_goes_on(capsys: pytest.CaptureFixture[str]) -> None:
    raised, _, shown = conversation(["p nothing", "nonsense(", "p message", "c"], 3, capsys)
    assert raised == ""
    assert "*** NameError" in shown
    assert "3" in shown.splitlines()


def test_nobody_listens(tmp_path: object) -> None:
    with pytest.raises(DebugError, match="nobody listens at"):
        call_under_pdb(callback, (1,), f"{tmp_path}/none")
