"""A signal handler of a native run takes no lock twice, wherever in the main thread it comes."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'rsltrace[ros]'")

from rsltrace.job import Job
from rsltrace.job.parts.record import LastSpec
from rsltrace.native import support
from rsltrace.native.last_seconds import LastSeconds
from rsltrace.native.native_run import NativeOptions, NativeRun
from rsltrace.native.observed_entities import ObservedEntities
from rsltrace.native.processes import observers
from rsltrace.native.processes.observers import SpanSender
from rsltrace.native.span_recorder import SpanRecorder, TaskCreation
from rsltrace.run.process import RunCallbacks
from rsltrace.simulation.loop.stop import Stop
from rsltrace.trace.model.event import EventKind

LINES = 60
"""More than are run before the middle of each of them was reached."""


def ends_if_interrupted(main: Callable[[], object], handler: Callable[[], object]) -> bool:
    """Run ``main``, and ``handler`` within it before each of its first lines, one after the other;
    return whether it has come to its end each time."""
    for number in range(LINES):
        left = iter(range(number))

        def trace(frame: Any, what: str, value: Any, left: Any = left) -> Any:
            if what == "line" and next(left, None) is None:
                handler()
            return trace

        def run(trace: Any = trace) -> None:
            sys.settrace(trace)
            main()

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        thread.join(600)
        if thread.is_alive():
            return False
    return True


def test_a_signal_ends_a_run_that_waits_and_one_that_is_ending() -> None:
    def main() -> None:
        run = NativeRun(Job(nodes=[{"node": "m:N"}]), RunCallbacks(), NativeOptions())
        run.span_writer = SimpleNamespace(error=None)  # type: ignore[assignment]
        runs[:] = [run]
        for _ in run.wait():
            pass
        run.stop(Stop("again"))

    def handler() -> None:
        if runs:
            runs[0].stop(Stop("signal"))

    runs: list[NativeRun] = []
    assert ends_if_interrupted(main, handler)
    assert runs[0].ending == Stop("signal")


def test_a_signal_may_come_while_another_one_has_a_file_written() -> None:
    last = LastSeconds(
        LastSpec(duration="10s"), SimpleNamespace(), None, lambda name: True, lambda reason: None
    )  # type: ignore[arg-type]

    def handler() -> None:
        last.trigger("SIGUSR1", at_once=True)

    assert ends_if_interrupted(handler, handler)


def test_a_program_may_shut_down_in_a_signal_handler(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was observed is told then, by a thread that waits for the lock of whom it interrupts."""
    monkeypatch.setattr(observers, "_WAITS_S", 0.002)
    monkeypatch.setattr(support, "_PART_S", 0.002)
    frames: list[tuple[Any, ...]] = []
    link = SimpleNamespace(send=lambda *frame: frames.append(frame))
    recorder = SpanRecorder()
    process = SimpleNamespace(
        recorder=recorder,
        entities=ObservedEntities(recorder.add),
        message_observer=SimpleNamespace(unreadable=0),
    )
    sender = SpanSender(link, process, lambda: True)  # type: ignore[arg-type]
    sender.start()

    def main() -> None:
        recorder.begin(int(EventKind.TIMER), None)
        recorder.add(TaskCreation())
        recorder.end()

    assert ends_if_interrupted(main, lambda: sender.tell_now(recorder.current()))
    sender.finish()
    sender.join()
    spans = [span for what, *values in frames if what == "spans" for span in values[-1]]
    assert sum(len(span[-1]) for span in spans) == LINES  # one task of each call of main
