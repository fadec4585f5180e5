"""`r` asks why the selected callback did not come or was late; `rsltrace why` says the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from rsltrace_viewer.terminal.screens.text import TextScreen

from rsltrace.cli.cat import why
from rsltrace.trace.model.event import EventKind

Drive = Callable[..., None]
SAMPLES = Path(__file__).parents[2] / "sample_traces" / "missing_event"


def _printed(*arguments: str) -> list[str]:
    return CliRunner().invoke(why, list(arguments)).stdout.splitlines()


def test_of_an_event_that_one_run_lacks_it_says_why_that_run_lacks_it(
    drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(SAMPLES)

    async def steps(viewer: Any) -> None:
        await viewer.press("r")
        screen = viewer.app.screen
        assert isinstance(screen, TextScreen)
        assert screen.text().plain.splitlines() == _printed(
            "b.mcap", "/gripper", "/close", "--at", "4.15"
        )
        assert "rsltrace why b.mcap /gripper /close --at 4.15" in viewer.text
        await viewer.press("enter")
        row = viewer.app.session.row(viewer.app.session.row_of_place())
        assert row.event.numbers[1] == "31"

    drive((Path("a.mcap"), Path("b.mcap")), steps)


def test_of_one_run_it_says_why_the_selected_callback_was_late(
    drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(SAMPLES)

    async def steps(viewer: Any) -> None:
        await viewer.press("r")
        assert "r asks about callbacks" in viewer.text, "a constructor is none"
        session = viewer.app.session
        for index in range(1, session.a.count):
            session.place = index
            question = session.question()
            if question is not None:
                command, lines, event = next(question.answers())
                assert lines == _printed("b.mcap", *command.split()[3:]), question
                if "as expected" in lines[0]:
                    resumed = session.a.event(index).kind is EventKind.RESUME
                    assert event == index or resumed, "the answer is about the selected event"

    drive(Path("b.mcap"), steps)


def test_in_the_overview_it_is_asked_about_the_whole_run(
    drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(SAMPLES)

    async def steps(viewer: Any) -> None:
        lines = viewer.text.splitlines()
        line = next(n for n, text in enumerate(lines) if "/picker client /close" in text)
        await viewer.press(*["down"] * (line - 1), "r")
        printed = _printed("b.mcap", "/picker", "/close")
        assert viewer.app.screen.text().plain.splitlines() == printed
        assert "had not ended at 10.0 s" in printed[0]

    drive(Path("b.mcap"), steps, overview=True)
