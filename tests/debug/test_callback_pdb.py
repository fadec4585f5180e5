"""``pdb`` in the first line of a callback, over a socket."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pytest

from rsltrace.debug.callback_pdb import call_under_pdb
from rsltrace.debug.prompt.command_table import talk
from rsltrace.errors import DebugError


def callback(message: int) -> int:
    doubled = 2 * message
    helped = helper(doubled)
    if message < 0:
        raise ValueError(f"negative: {message}")
    return helped


def helper(value: int) -> int:
    return value + 1


def default(value: object) -> str:
    return type(value).__name__


def conversation(
    lines: Sequence[str],
    message: object,
    capsys: pytest.CaptureFixture[str],
    called: Callable[..., Any] = callback,
) -> tuple[str, list[str], str]:
    """Return what the callback raised, the prompts at which lines were read, what was shown."""
    left, prompts = list(lines), []

    def read(prompt: str) -> str | None:
        prompts.append(prompt)
        return left.pop(0) if left else None

    raised = talk(lambda address: call_under_pdb(called, (message,), address), read)
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


def test_it_stops_in_the_first_line_of_the_users(capsys: pytest.CaptureFixture[str]) -> None:
    """As that of a coroutine, which Python's own modules are asked about before it runs."""
    dumps = partial(json.dumps, default=default)
    shown = conversation(["p value", "c"], {1, 2}, capsys, dumps)[2].splitlines()
    assert shown[0].endswith("default()")
    assert shown[1:3] == ["-> return type(value).__name__", "{1, 2}"]


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
    with pytest.raises(DebugError, match="no client listens at"):
        call_under_pdb(callback, (1,), f"{tmp_path}/none")
