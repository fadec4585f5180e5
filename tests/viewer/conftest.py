"""Traces to look at: made ones, the samples, broken ones; and ways to drive the app."""

from __future__ import annotations

import asyncio
import importlib.util
import sys
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("textual", reason="needs textual: pip install 'rsltrace[view]'")

import textual.app
from rsltrace_viewer.model.run import Run
from rsltrace_viewer.terminal import screenshot, shell
from rsltrace_viewer.terminal.app import ViewerApp, open_session
from rsltrace_viewer.terminal.screenshot import settle, text_of
from textual.pilot import Pilot

from tests.golden_files import check_golden

if "trace_maker" not in sys.modules:
    _spec = importlib.util.spec_from_file_location(
        "trace_maker", Path(__file__).parent.parent / "trace" / "make.py"
    )
    assert _spec is not None
    assert _spec.loader is not None
    _module = importlib.util.module_from_spec(_spec)
    sys.modules["trace_maker"] = _module
    _spec.loader.exec_module(_module)

screenshot._SETTLE_S = 600.0  # settling ends with the work; on a loaded machine that takes its time
screenshot._PAUSE_S = 0.01
shell._VALUES_S = 0.001  # a test stops at every event


async def _give_way(*_: float) -> None:
    """Stand in for Textual's wait for an idle processor after each key: ``settle`` follows."""
    await asyncio.sleep(0)


textual.app.wait_for_idle = _give_way

SAMPLES = Path(__file__).parents[2] / "sample_traces"
GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two nodes: 603 events with services, logs, and an exception at the end."""
    from trace_maker import write_run

    path = tmp_path_factory.mktemp("viewer") / "made.mcap"
    write_run(path, 600)
    return path


@pytest.fixture(scope="session")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of several segments."""
    from trace_maker import write_run

    path = tmp_path_factory.mktemp("viewer") / "long.mcap"
    write_run(path, 30_000)
    return path


@pytest.fixture(scope="session")
def run(made: Path) -> Iterator[Run]:
    """The made run, opened."""
    opened = Run.open(made)
    yield opened
    opened.close()


@pytest.fixture(scope="session")
def long_run(long: Path) -> Iterator[Run]:
    """The run of several segments, opened."""
    opened = Run.open(long)
    yield opened
    opened.close()


@pytest.fixture
def pair() -> tuple[Path, Path]:
    """Two runs of one job that diverge, from the samples."""
    folder = SAMPLES / "nondeterministic_callback"
    return folder / "a.mcap", folder / "b.mcap"


@pytest.fixture
def golden() -> object:
    """``golden(name, text)`` compares with a golden file."""
    return lambda name, text: check_golden(GOLDEN / name, text)


class Driver:
    """An app that runs without a terminal, for the duration of a ``with``-block of asyncio."""

    def __init__(self, app: ViewerApp, pilot: Pilot[None]) -> None:
        self.app = app
        self._pilot = pilot

    async def settle(self) -> None:
        """Wait until nothing is under way."""
        await settle(self.app, self._pilot.pause)

    async def press(self, *keys: str) -> None:
        """Press keys, each after the one before has had its effect."""
        for key in keys:
            await self._pilot.press(key)
            await self.settle()

    async def type(self, text: str) -> None:
        """Type a text and Enter."""
        await self._pilot.press(*[_NAMES.get(c, c) for c in text], "enter")
        await self.settle()

    async def click(self, selector: str, x: int, y: int) -> None:
        """Click into a widget."""
        await self._pilot.click(selector, offset=(x, y))
        await self.settle()

    async def resize(self, width: int, height: int) -> None:
        """Change the size of the terminal."""
        await self._pilot.resize_terminal(width, height)
        await self.settle()

    @property
    def place(self) -> int:
        """The selected row."""
        return self.app.session.place

    @property
    def text(self) -> str:
        """The screen."""
        return text_of(self.app)


_NAMES = {
    " ": "space",
    ":": "colon",
    "/": "slash",
    "-": "minus",
    ".": "full_stop",
    ",": "comma",
    '"': "quotation_mark",
    "(": "left_parenthesis",
    ")": "right_parenthesis",
    ">": "greater_than_sign",
}


def drive(
    paths: Path | tuple[Path, ...],
    steps: Callable[[Driver], Awaitable[None]],
    size: tuple[int, int] = (120, 36),
    **options: Any,
) -> None:
    """Open one or two traces in the app and run ``steps`` with it."""
    names = paths if isinstance(paths, tuple) else (paths,)

    async def run_app() -> None:
        session = open_session(*names)
        app = ViewerApp(session, **options)
        try:
            async with app.run_test(size=size, notifications=True) as pilot:
                driver = Driver(app, pilot)
                await driver.settle()
                await steps(driver)
        finally:
            session.close()

    asyncio.run(run_app())


@pytest.fixture(name="drive")
def drive_fixture() -> object:
    """``drive(paths, steps, size, ...)`` runs the app and ``async def steps(driver)``."""
    return drive


@pytest.fixture(scope="session")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trace with all that is odd: fan-out, a 10 MB message, types that cannot be decoded, names
    with wide characters and with what steers terminals, a payload that was not kept, a warning."""
    from trace_maker import CDR, LOG_SCHEMA, Opened, cdr_string, log_message

    from rsltrace.trace.model.entity import EntityKind
    from rsltrace.trace.model.event import EventFlag, EventKind, OutputKind

    path = tmp_path_factory.mktemp("viewer") / "odd.mcap"
    with Opened(path) as feeder:
        writer = feeder.writer
        node = feeder.entity(EntityKind.NODE, "/ロボット_手_とても長い名前のノード")
        evil = feeder.entity(EntityKind.NODE, "/evil\x1b[2J\u202enode[bold]")
        timer = feeder.entity(EntityKind.TIMER, "tick", node=node)
        big = feeder.entity(EntityKind.PUBLISHER, "/big", node=node, type_="x_msgs/msg/Big")
        bad = feeder.entity(EntityKind.PUBLISHER, "/bad", node=node, type_="x_msgs/msg/Bad")
        rosout = feeder.entity(
            EntityKind.PUBLISHER, "/rosout", node=evil, type_="rcl_interfaces/msg/Log"
        )
        words = feeder.entity(EntityKind.PUBLISHER, "/[red]", node=evil, type_="x_msgs/msg/Text")
        subs = [
            feeder.entity(EntityKind.SUBSCRIPTION, "/big", node=evil, type_="x_msgs/msg/Big")
            for _ in range(3)
        ]
        channels = {
            "big": writer.add_channel("/big", "x_msgs/msg/Big", "uint8[] data\n"),
            "bad": writer.add_channel("/bad", "x_msgs/msg/Bad", "nonsense is no schema {{{\n"),
            "log": writer.add_channel("/rosout", "rcl_interfaces/msg/Log", LOG_SCHEMA),
            "text": writer.add_channel("/[red]", "x_msgs/msg/Text", "string text\n"),
        }
        for created in (node, evil):
            feeder.output(OutputKind.ENTITY, created, b"identity")
        feeder.event(EventKind.CONSTRUCT, 0, 0)
        data = CDR + (10_000_000).to_bytes(4, "little") + bytes(10_000_000)
        feeder.output(OutputKind.MESSAGE, big, data, feeder.payload(channels["big"], 5, data))
        cause = feeder.event(EventKind.TIMER, timer, 5)
        for subscription in subs:
            feeder.event(EventKind.SUBSCRIPTION, subscription, 5, input_hash=1, cause=(cause, 0))
        feeder.output(
            OutputKind.MESSAGE, bad, b"junk", feeder.payload(channels["bad"], 6, b"junk" * 100)
        )
        feeder.output(OutputKind.MESSAGE, bad, b"not kept")
        feeder.event(EventKind.TIMER, timer, 6, flags=EventFlag.SUSPENDED)
        text = cdr_string(CDR, "日本語\x1b]0;title\x07[bold]text[/bold]\n\u202e")
        feeder.output(OutputKind.MESSAGE, words, text, feeder.payload(channels["text"], 7, text))
        log = log_message(7, 30, "evil", "too \x1b[31m far [link=x]")
        feeder.output(OutputKind.LOG, rosout, log, feeder.payload(channels["log"], 7, log))
        feeder.event(EventKind.TIMER, 99, 7)  # an entity that the trace does not describe
        writer.close(result={"stop_reason": "done", "exit_code": "0"})
    return path
