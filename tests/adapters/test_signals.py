"""Handlers of signals that nodes set: each main has its own, the process keeps what it had."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import (
    SignalHandlerOptions,
    get_current_signal_handlers_options,
    install_signal_handlers,
    uninstall_signal_handlers,
)
from std_msgs.msg import UInt64

from rsltrace import NodeSpec

pytestmark = pytest.mark.ros


def handle(number: int, frame: object) -> None:
    raise AssertionError("nobody sends this")


def other(number: int, frame: object) -> None:
    raise AssertionError("nobody sends this")


def main_of(own: Any, seen: list[Any]) -> NodeSpec:
    def main() -> None:
        rclpy.init()
        node = Node("node")
        seen.append(signal.signal(signal.SIGINT, own))
        node.create_timer(0.5, lambda: seen.append(signal.getsignal(signal.SIGINT)))
        rclpy.spin(node)

    return NodeSpec(main=main, namespace=f"/{own.__name__}")


def test_each_main_has_its_own_and_the_process_keeps_its(simulate: Any) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    seen: list[Any] = []
    simulate(main_of(handle, seen), main_of(other, seen), duration=1.1)
    assert seen == [before[0], before[0], handle, other, handle, other]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_handlers_of_other_signals_work_until_the_run_is_over(simulate: Any) -> None:
    before = signal.getsignal(signal.SIGUSR1)
    seen: list[int] = []

    class Kicks(Node):
        def __init__(self) -> None:
            super().__init__("kicks")
            signal.signal(signal.SIGUSR1, lambda number, frame: seen.append(number))
            self.create_timer(0.5, lambda: os.kill(os.getpid(), signal.SIGUSR1))

    simulate(Kicks, duration=1.1)
    assert seen == [signal.SIGUSR1, signal.SIGUSR1]
    assert signal.getsignal(signal.SIGUSR1) is before


SENDERS = [lambda number: os.kill(os.getpid(), number), signal.raise_signal]


@pytest.mark.parametrize("send", SENDERS, ids=["kill", "raise_signal"])
def test_who_sends_itself_a_signal_is_told_as_it_has_said(simulate: Any, send: Any) -> None:
    seen: list[Any] = []

    class Told(Node):
        def __init__(self) -> None:
            super().__init__("told")
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            signal.signal(signal.SIGINT, self.on_interrupt)
            self.create_timer(0.5, self.tick)

        def on_interrupt(self, number: int, frame: Any) -> None:
            seen.append((number, frame.f_code.co_name))

        def tick(self) -> None:
            send(signal.SIGTERM)
            send(signal.SIGINT)
            seen.append("went on")

    recorded = simulate(Told, duration=0.6)
    assert [one for one in seen if one == "went on"] == ["went on"]
    assert seen[0][0] == signal.SIGINT
    assert seen[0][1] in ("tick", "<lambda>")
    assert recorded.result.exit_code == 0


def test_a_default_that_ends_the_process_ends_the_main(simulate: Any) -> None:
    def main() -> None:
        rclpy.init()
        node = Node("node")
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        node.create_timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
        rclpy.spin(node)

    recorded = simulate(NodeSpec(main=main), duration=3)
    assert recorded.result.exit_code == 130
    assert recorded.result.end_ns == 500_000_000
    assert any("os.kill with SIGINT for itself" in note for note in recorded.result.notes)


def test_mistakes_are_those_that_python_reports(simulate: Any) -> None:
    said: list[str] = []

    class Wrong(Node):
        def __init__(self) -> None:
            super().__init__("wrong")
            self.try_(signal.SIGTERM, "nothing to call")
            self.try_(1000, signal.SIG_IGN)
            thread = threading.Thread(target=self.try_, args=(signal.SIGTERM, signal.SIG_IGN))
            thread.start()
            thread.join()

        def try_(self, number: int, handler: Any) -> None:
            try:
                signal.signal(number, handler)
            except (TypeError, ValueError) as error:
                said.append(str(error))

    simulate(Wrong, duration=0.1)
    assert said == [
        "signal handler must be signal.SIG_IGN, signal.SIG_DFL, or a callable object",
        "signal number out of range",
        "signal only works in main thread of the main interpreter",
    ]


def sends_itself(number: int, seen: list[Any], *, thread: bool = False) -> NodeSpec:
    def send() -> None:
        os.kill(os.getpid(), number)
        seen.append("went on")

    def main() -> None:
        rclpy.init()
        node = Node("node")
        node.create_timer(0.5, threading.Thread(target=send).start if thread else send)
        try:
            rclpy.spin(node)
        except KeyboardInterrupt as error:
            seen.append(type(error))
        seen.append(rclpy.ok())
        if number == signal.SIGINT and not thread:
            raise KeyboardInterrupt

    return NodeSpec(main=main)


class Other(Node):
    def __init__(self) -> None:
        super().__init__("other")
        self.create_timer(1.0, lambda: None)


@pytest.mark.parametrize("thread", [False, True], ids=["callback", "thread"])
def test_ctrl_c_from_a_main_for_itself_interrupts_that_main(simulate: Any, thread: bool) -> None:
    """As key_teleop ends: SIGINT to its own process, with nobody's handler but Python's."""
    seen: list[Any] = []
    recorded = simulate(sends_itself(signal.SIGINT, seen, thread=thread), Other, duration=3)
    assert seen == [*(["went on"] if thread else []), KeyboardInterrupt, False]
    assert recorded.result.end_ns == 3_000_000_000  # the run goes on without it
    assert recorded.result.exit_code == (0 if thread else 130)
    assert any("exited with 130 at 0.5" in note for note in recorded.result.notes) is not thread


def test_sigterm_from_a_main_for_itself_shuts_rclpy_down(simulate: Any) -> None:
    seen: list[Any] = []
    recorded = simulate(sends_itself(signal.SIGTERM, seen), Other, duration=3)
    assert seen == ["went on", False]  # spin returns: the context is no longer valid
    assert recorded.result.end_ns == 3_000_000_000
    assert recorded.result.exit_code == 0


@pytest.mark.parametrize("own", ["NO", "SIGTERM", "context"])
def test_without_the_handler_of_rclpy_an_interrupted_main_may_still_publish(
    simulate: Any, own: str
) -> None:
    seen: list[Any] = []

    def interrupted(number: int, send: Callable[[], None]) -> NodeSpec:
        def main() -> None:
            context = rclpy.Context()
            if own == "context":
                rclpy.init(context=context)  # which installs no handlers
            else:
                rclpy.init(
                    context=context, signal_handler_options=getattr(SignalHandlerOptions, own)
                )
            node = Node("node", context=context)
            publisher = node.create_publisher(UInt64, "last", 10)
            node.create_timer(0.5 + number, send)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            try:
                executor.spin()
            except KeyboardInterrupt:
                publisher.publish(UInt64(data=7))
                seen.append(context.ok())

        return NodeSpec(main=main)

    both = (lambda: signal.raise_signal(signal.SIGINT)), (lambda: None)  # itself; by the end
    recorded = simulate(*(interrupted(n, send) for n, send in enumerate(both)), Other, duration=3)
    assert seen == [True, True]
    assert recorded.result.exit_code == 0


def test_handlers_are_installed_once_in_each_main(simulate: Any) -> None:
    seen: list[tuple[str, str]] = []

    def installs(name: str, *options: str) -> NodeSpec:
        def main() -> None:
            for option in options:
                install_signal_handlers(getattr(SignalHandlerOptions, option))
                seen.append((name, get_current_signal_handlers_options().name))
            uninstall_signal_handlers()
            seen.append((name, get_current_signal_handlers_options().name))

        return NodeSpec(main=main)

    simulate(installs("a", "NO", "SIGINT", "ALL", "NO"), installs("b", "SIGTERM"), duration=1)
    told = ["NO", "SIGINT", "SIGINT", "SIGINT", "NO"]  # as natively
    assert seen == [*(("a", one) for one in told), ("b", "SIGTERM"), ("b", "NO")]


def test_sigterm_ends_a_main_without_rclpy(simulate: Any) -> None:
    def main() -> None:
        signal.raise_signal(signal.SIGTERM)
        raise AssertionError("it is dead")

    recorded = simulate(NodeSpec(main=main), Other, duration=1)
    assert recorded.result.exit_code == 128 + signal.SIGTERM
