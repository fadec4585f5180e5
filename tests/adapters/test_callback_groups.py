"""Callback groups of the user's own are asked and told as rclpy's executors do it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from rsltrace import NodeSpec
from rsltrace.errors import RunError
from tests.adapters.callback_groups_program import Alternating, Counting, Gate

pytestmark = pytest.mark.ros

PROGRAM = Path(__file__).with_name("callback_groups_program.py")
EXPECTED = {
    "count": [
        {
            f"{kind} {what}": 1
            for kind in ("Client", "GuardCondition", "Service", "Subscription", "Timer")
            for what in ("begins", "ends")
        },
        {"coroutine": 1, "message": 1, "service": 1, "timer": 1},
    ],
    "limit": [2, [0, 1, 2, 3, 4]],
    "alternate": True,
    "gate": ["open", "through", "through"],
}


def told(text: str) -> Any:
    return json.loads(text.splitlines()[-1])


def test_in_the_users_own_executors(simulate: Any, capfd: Any) -> None:
    simulate(NodeSpec(script=PROGRAM))
    assert told(capfd.readouterr().out) == EXPECTED


@pytest.mark.native
@pytest.mark.usefixtures("own_domain")
def test_in_rclpy_itself() -> None:
    done = subprocess.run(
        [sys.executable, PROGRAM], capture_output=True, text=True, check=True, timeout=1200
    )
    assert told(done.stdout) == EXPECTED


def test_in_nodes_that_the_job_constructs(simulate: Any) -> None:
    log: list[str] = []
    groups: list[Any] = []

    class Grouped(Node):
        def __init__(self) -> None:
            super().__init__("grouped")
            alternating, counting, gate = Alternating(), Counting(), Gate()
            groups.extend((counting, gate))
            self.create_timer(0.3, lambda: log.append("a"), callback_group=alternating)
            self.create_timer(0.1, lambda: log.append("b"), callback_group=alternating)
            self.create_timer(0.1, lambda: None, callback_group=counting)
            self.create_timer(0.1, lambda: log.append("through"), callback_group=gate)
            self.create_timer(0.75, self.let_in)

        def let_in(self) -> None:
            groups[1].open = True
            log.append("open")

    simulate(Grouped, duration=0.95)
    assert "".join(one for one in log if len(one) == 1).startswith("baba")
    assert log.index("open") + 1 == log.index("through")
    assert groups[0].counts == {"Timer begins": 9, "Timer ends": 9}


def test_a_group_that_raises_is_named(simulate: Any) -> None:
    class Broken(CallbackGroup):
        def can_execute(self, entity: Any) -> bool:
            raise ValueError("no idea")

    class Grouped(Node):
        def __init__(self) -> None:
            super().__init__("grouped")
            self.create_timer(0.1, lambda: None, callback_group=Broken())

    with pytest.raises(RunError, match=r"Broken\.can_execute raised ValueError: no idea"):
        simulate(Grouped, duration=1)
