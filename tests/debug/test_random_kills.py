"""Whoever of a session is killed at whatever moment: it is said, and nothing stays behind."""

from __future__ import annotations

import os
import random
import signal
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from rsltrace import DebugSession
from rsltrace.errors import DebugError
from tests.debug.test_trouble import children_of, nothing_left

pytestmark = pytest.mark.ros
__all__ = ["nothing_left"]

MOVES = ("go_to", "step", "reverse_step", "go_on", "evaluate", "edges")
EVENTS = 900


def move(session: DebugSession, rng: random.Random) -> None:
    """Do something that takes some time."""
    kind = rng.choice(MOVES)
    if kind == "go_to":
        session.go_to(rng.randrange(EVENTS))
    elif kind == "step":
        session.go_to(rng.randrange(EVENTS - 100))
        session.step(50)
    elif kind == "reverse_step":
        session.reverse_step(rng.randrange(1, 20))
    elif kind == "go_on":
        session.go_on()
    elif kind == "evaluate":
        session.evaluate("now + 1")
    else:
        session.go_to(EVENTS)
        session.go_to(0)


def moves_until_trouble(
    session: DebugSession, rng: random.Random, told: list[Exception], end: threading.Event
) -> None:
    try:
        while not end.is_set():
            move(session, rng)
    except Exception as error:
        told.append(error)


@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, 12), marks=pytest.mark.long)], ids=["few", "many"]
)
def test_processes_of_the_simulation(seeds: range, folder: Path) -> None:
    """The session goes on, to where it would have gone."""
    with DebugSession(folder / "run.mcap", trust=True) as session:
        session.go_to(300)
        state = session.evaluate("filter.state")
        for seed in seeds:
            rng, told, end = random.Random(seed), list[Exception](), threading.Event()
            thread = threading.Thread(target=moves_until_trouble, args=(session, rng, told, end))
            thread.start()
            time.sleep(rng.random())
            children = children_of(session)
            for pid in rng.sample(children, rng.randint(1, len(children))) if children else ():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.2)
            end.set()
            thread.join()
            for error in told:
                assert isinstance(error, DebugError), (seed, error)
                assert "SIGKILL" in str(error), (seed, error)
            with suppress(DebugError):  # the process that stands there may have been killed, too:
                session.evaluate("now + 1")  # that is said when it is asked for something
            assert session.go_to(300).position.index == 300, seed
            assert session.evaluate("filter.state") == state, seed


@pytest.mark.long
@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, 8), marks=pytest.mark.long)], ids=["few", "many"]
)
@pytest.mark.parametrize("who", ["supervisor", "client"])
def test_the_supervisor_or_the_client(who: str, seeds: range, folder: Path) -> None:
    """In the middle of a request; ``nothing_left`` looks for what stays behind."""
    for seed in seeds:
        rng, told, end = random.Random(seed), list[Exception](), threading.Event()
        session = DebugSession(folder / "run.mcap", trust=True)
        thread = threading.Thread(target=moves_until_trouble, args=(session, rng, told, end))
        thread.start()
        time.sleep(rng.random())
        if who == "supervisor":
            os.kill(session._process.pid, signal.SIGKILL)
        else:
            session._lines._end.shutdown(socket.SHUT_RDWR)
        thread.join()
        assert isinstance(told[0], DebugError), (seed, told)
        assert "the session is over" in str(told[0]), (seed, told)
        session.close()
