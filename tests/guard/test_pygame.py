"""Games of pygame run on simulated time: its waits and its clock, which are C's."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.guard.conftest import list_as_wheel, node_code

pytestmark = pytest.mark.ros

STAND_IN = """
import time as _time
class Clock: pass
def get_ticks(): return int(_time.monotonic() * 1000) + 12345
def wait(ms): raise AssertionError("a real wait")
delay = wait
"""
GAME = """
import pygame, rclpy
from pygame.time import Clock
def main():
    rclpy.init()
    node = N()
    clock, frames, ticks = Clock(), [], pygame.time.get_ticks()
    while len(frames) < 30:
        rclpy.spin_once(node, timeout_sec=0)
        frames.append(clock.tick(50))
    passed = pygame.time.get_ticks() - ticks
    node.say([*set(frames)], node.ticked, passed, round(clock.get_fps()), clock.get_time())
    node.say(pygame.time.wait(100), pygame.time.delay(0), pygame.time.get_ticks() - ticks)
"""


INSTALLED = importlib.util.find_spec("pygame") is not None


@pytest.fixture
def forgotten() -> Iterator[None]:
    """Have pygame loaded by the run, and by nobody later on."""

    def forget() -> None:
        for name in [name for name in sys.modules if name.partition(".")[0] == "pygame"]:
            del sys.modules[name]

    forget()
    yield
    forget()


@pytest.mark.usefixtures("forgotten")
@pytest.mark.parametrize("real", [False, True], ids=["stand-in", "pygame"])
def test_a_game_loop_takes_simulated_time(
    said: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, real: bool
) -> None:
    if real and not INSTALLED:
        pytest.skip("pygame is not installed")
    if not real:
        package = tmp_path / "site-packages" / "pygame"
        package.mkdir(parents=True)
        (package / "__init__.py").write_text("from pygame import time\n")
        (package / "time.py").write_text(STAND_IN)
        list_as_wheel(package.parent, "pygame")
        monkeypatch.syspath_prepend(str(package.parent))
    code = node_code("self.ticked += 1", init="self.ticked = 0") + GAME
    first, second = said(code, job="nodes: [{main: 'm:main'}]")
    assert first == [[20], 1, 600, 50, 20]
    assert second == [100, 0, 700]
