"""Where the code of every callback is: in the trace, and in what reads it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from rsltrace.cli.main import cli
from rsltrace.trace.reader import Trace

pytestmark = pytest.mark.ros

CODE = """
import functools, threading
from std_srvs.srv import Trigger

def logged(function):
    @functools.wraps(function)
    def run(*given):
        return function(*given)
    return run

class Counter:
    def __call__(self, message):
        '''here: called'''

class Odd(Node):
    def __init__(self):
        '''here: constructor'''
        super().__init__('odd')
        self.speed = self.declare_parameter('speed', 1.0).value
        self.publisher = self.create_publisher(UInt64, 'doubled', 10)
        self.create_subscription(UInt64, 'numbers', self.decorated, 10)
        self.create_subscription(UInt64, 'called', Counter(), 10)
        self.create_subscription(UInt64, 'lambda', lambda m: m, 10)  # here: lambda
        self.create_subscription(UInt64, 'coroutine', self.coroutine, 10)
        self.create_subscription(UInt64, 'built_in', print, 10)
        self.create_timer(1.0, functools.partial(self.partial, 1))
        self.create_service(Trigger, 'serve', self.serve)
        threading.Thread(target=self.thread, name='worker').start()

    @logged
    def decorated(self, message):
        '''here: decorated'''
        self.publisher.publish(UInt64(data=int(self.speed * message.data)))

    async def coroutine(self, message):
        '''here: coroutine'''

    def partial(self, number):
        '''here: partial'''

    def serve(self, request, response):
        '''here: serve'''
        return response

    def thread(self):
        '''here: thread'''
"""
JOB = """
nodes:
  - {node: nodes_under_test:Talker}
  - {node: nodes_under_test:Odd, parameters: {speed: SPEED}}
stop: {duration: 2s}
"""


def line_of(code: str, what: str) -> int:
    """Return the line in which a function begins, from 1: that of its decorator, if it has one."""
    lines = code.splitlines()
    at = next(number for number, line in enumerate(lines) if f"here: {what}" in line)
    while "def " not in lines[at] and "lambda" not in lines[at]:
        at -= 1
    return at + (0 if lines[at - 1].strip().startswith("@") else 1)


def test_every_callback_has_its_place_and_a_diff_points_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_job: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, speed in (("a", "1.0"), ("b", "2.0")):
        assert record_job(JOB.replace("SPEED", speed), CODE, f"{name}.mcap").error is None
    code = Path("nodes_under_test.py").read_text()
    with Trace.open(Path("a.mcap")) as trace:
        places = {entity.name: entity.source for entity in trace.entities.values()}
        found = {name: place for name, place in places.items() if place.startswith("nodes_")}
    here = {
        "/odd": "constructor",
        "/numbers": "decorated",
        "/called": "called",
        "/lambda": "lambda",
        "/coroutine": "coroutine",
        "partial(Odd.partial)": "partial",
        "/serve": "serve",
        "worker": "thread",
    }
    for name, what in here.items():
        assert found[name] == f"nodes_under_test.py:{line_of(code, what)}", name
    assert places["/built_in"] == ""
    assert places["/odd/get_parameters"].startswith("rclpy/parameter_service.py:")

    events = CliRunner().invoke(cli, ["cat", "--json", "a.mcap"]).output.splitlines()
    made = [event["code"] for event in map(json.loads, events) if event["kind"] == "construct"]
    assert f"nodes_under_test.py:{line_of(code, 'constructor')}" in made
    assert found["/serve"] in CliRunner().invoke(cli, ["info", "a.mcap"]).output
    assert found["/numbers"] in CliRunner().invoke(cli, ["cat", "--code", "a.mcap"]).output

    report = CliRunner().invoke(cli, ["diff", "a.mcap", "b.mcap", "--all"])
    assert f"({found['/numbers']})" in report.output, report.output
    notes = CliRunner().invoke(cli, ["diff", "a.mcap", "b.mcap", "--format", "github"]).output
    lines = code.splitlines()
    sent = 1 + next(i for i, line in enumerate(lines) if "int(self.speed * message" in line)
    assert f"::error file=nodes_under_test.py,line={sent}," in notes
    Path("nodes_under_test.py").unlink()
    notes = CliRunner().invoke(cli, ["diff", "a.mcap", "b.mcap", "--format", "github"]).output
    assert "::error file=a.mcap," in notes
