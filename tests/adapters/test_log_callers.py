"""Who logs, as rclpy itself finds it: the same file, function and line, the same filters."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

LOGGING = '''
import rclpy.logging
from rclpy.clock import Clock
from rclpy.time import Time

class Slow(Clock):
    ticks = 0
    def now(self):
        Slow.ticks += 1
        return Time(nanoseconds=10**18 + Slow.ticks * 400_000_000)

def helper(logger, text, **filters):
    logger.info(text, **filters)

def speak(logger):
    """Log from all kinds of places, some of them again and again."""
    slow = Slow()
    for turn in range(6):
        logger.info(f"plain {turn}")
        logger.info(f"once {turn}", once=True); logger.info(f"same line {turn}", once=True)
        logger.warning(f"not the first {turn}", skip_first=True)
        logger.error(f"both {turn}", skip_first=True, once=True)
        logger.info(f"slow {turn}", throttle_duration_sec=1.0, throttle_time_source_type=slow)
        helper(logger, f"helper {turn}", once=True)
        (lambda: logger.fatal(f"lambda {turn}", once=True))()
        [logger.warn(f"list {turn}", once=True) for _ in range(2)]
        exec(f"logger.info('exec {turn}', once=True)")
        code = compile(f"logger.info('named {turn}')", "/nowhere/made_up.py", "exec")
        exec(code, {"logger": logger})
        logger.log(f"log {turn}", rclpy.logging.LoggingSeverity.INFO, name="another")
        for severity in (logger.info, logger.warning):
            try:
                severity(f"severity {turn}")
            except ValueError as error:
                logger.info(str(error))
        for options in ({"once": True}, {}):
            try:
                logger.info(f"filters {turn}", **options)
            except ValueError as error:
                logger.info(str(error))
        try:
            logger.info("wrong", nonsense=True)
        except TypeError as error:
            logger.info(str(error))
    logger.info(b"bytes")
    logger.info(None)
    rclpy.logging.get_logger("child").info("another logger")
'''
NODE = """
from rclpy.node import Node
from speaking import speak

class Speaker(Node):
    def __init__(self):
        super().__init__("speaker")
        speak(self.get_logger())
"""


def natively(folder: Path) -> list[str]:
    """What rclpy prints of the records without rsltrace."""
    marked = "RECORD|{name}|{severity}|{message}|{function_name}|{file_name}|{line_number}"
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import rclpy.logging, speaking; speaking.speak(rclpy.logging.get_logger('speaker'))",
        ],
        env=os.environ | {"RCUTILS_CONSOLE_OUTPUT_FORMAT": marked, "PYTHONPATH": str(folder)},
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    said = (done.stdout + done.stderr).splitlines()
    return [line.removeprefix("RECORD|") for line in said if line.startswith("RECORD|")]


def test_callers_and_filters_are_those_of_rclpy(
    simulate: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "speaking.py").write_text(LOGGING)
    (tmp_path / "a_speaker.py").write_text(NODE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    run = simulate("a_speaker:Speaker", duration=0.1)
    names = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR", 50: "FATAL"}
    with run.trace() as trace:
        found = [trace.decode("/rosout", data) for _, _, data in trace.messages("/rosout")]
    here = [
        f"{m.name}|{names[m.level]}|{m.msg}|{m.function}|{os.path.basename(m.file)}|{m.line}"
        for m in found
    ]
    native = [line.split("|") for line in natively(tmp_path)]
    for each in native:  # the console's file is the path, that of a trace is relative to the job
        each[4] = os.path.basename(each[4])
    assert here == ["|".join(each) for each in native]
    assert len(here) > 50


def test_a_file_is_looked_at_once(simulate: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import inspect

    from rclpy.node import Node

    looks = 0
    real = inspect.getframeinfo

    def counting(*arguments: Any, **options: Any) -> Any:
        nonlocal looks
        looks += 1
        return real(*arguments, **options)

    monkeypatch.setattr(inspect, "getframeinfo", counting)

    class Chatty(Node):
        def __init__(self) -> None:
            super().__init__("chatty")
            for number in range(200):
                self.get_logger().info(f"record {number}")

    assert len(simulate(Chatty, duration=0.1).logs()) == 200
    assert looks < 20


def test_rclpy_is_as_it_was_after_a_run(simulate: Any) -> None:
    from rclpy.impl import rcutils_logger
    from rclpy.node import Node

    before = rcutils_logger.CallerId

    class Looking(Node):
        def __init__(self) -> None:
            super().__init__("looking")
            self.get_logger().info(f"{rcutils_logger.CallerId is not before}")

    assert simulate(Looking, duration=0.1).logs() == ["True"]
    assert rcutils_logger.CallerId is before


@pytest.mark.parametrize("message", [["a list"], 3])
def test_what_is_no_text_is_refused(simulate: Any, message: object) -> None:
    from rclpy.node import Node

    refused = []

    class Odd(Node):
        def __init__(self) -> None:
            super().__init__("odd")
            try:
                self.get_logger().info(message)
            except TypeError as error:
                refused.append(error)

    assert simulate(Odd, duration=0.1).logs() == []
    assert refused
