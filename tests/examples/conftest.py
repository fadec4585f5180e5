"""Loading the examples as a job does, and a small simulator to run their nodes on without ROS.

The simulator is written for these tests alone and shares no code with rsltrace's loop: where both
give what an oracle says, neither does so by accident.
"""

from __future__ import annotations

import importlib
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"


class Sim:
    """FIFO events, then the due timer of the smallest (deadline, creation), then time moves."""

    def __init__(self) -> None:
        self.now = 0
        self.callbacks = 0
        self.ready: deque[Callable[[], None]] = deque()
        self.timers: list[SimpleNamespace] = []
        self.subscriptions: dict[str, list[tuple[deque[Any], Callable[[Any], None]]]] = {}
        self.services: dict[str, Callable[[Any, Any], Any]] = {}
        self.parameters: dict[str, Any] = {}
        self.published: list[tuple[str, Any]] = []
        self.counts: Counter[str] = Counter()
        self.logs: list[str] = []

    def publish(self, topic: str, message: Any) -> None:
        self.published.append((topic, message))
        self.counts[topic] += 1
        for waiting, callback in self.subscriptions.get(topic, ()):
            waiting.append(message)
            self.ready.append(lambda w=waiting, c=callback: self._take(w, c))

    def _take(self, waiting: deque[Any], callback: Callable[[Any], None]) -> None:
        if waiting:  # else the message was dropped, and its event is a left-over
            self.callbacks += 1
            callback(waiting.popleft())

    def call(self, service: str, request: Any) -> SimpleNamespace:
        future = SimpleNamespace(callbacks=[])
        future.add_done_callback = future.callbacks.append

        def respond(response: Any) -> None:
            self.callbacks += 1
            future.result = lambda: response
            for callback in future.callbacks:
                callback(future)

        def serve() -> None:
            self.callbacks += 1
            response = self.services[service](request, SimpleNamespace(success=False, message=""))
            self.ready.append(lambda: respond(response))

        self.ready.append(serve)
        return future

    def timer(self, period_ns: int, callback: Callable[[], None]) -> SimpleNamespace:
        timer = SimpleNamespace(deadline=self.now + period_ns, period=period_ns, callback=callback)
        timer.cancel = lambda: self.timers.remove(timer) if timer in self.timers else None
        self.timers.append(timer)
        return timer

    def run(self, start_ns: int, done: Callable[[], bool]) -> None:
        """Run until ``done`` between two time steps, or until nothing can happen any more."""
        self.now = start_ns
        while True:
            while self.ready:
                self.ready.popleft()()
            timer = min(self.timers, key=lambda each: each.deadline, default=None)
            if timer is not None and timer.deadline <= self.now:
                timer.deadline += timer.period
                if timer.deadline <= self.now:
                    timer.deadline += (
                        1 + (self.now - timer.deadline) // timer.period
                    ) * timer.period
                self.callbacks += 1
                timer.callback()
            elif timer is None or done():
                return
            else:
                self.now = timer.deadline


def _fake_ros(sim: Sim) -> dict[str, ModuleType]:
    """Return stand-ins, on ``sim``, for the few ROS names that the small examples use."""

    class Node:
        def __init__(self, name: str, *, namespace: str = "") -> None:
            self.name = name
            self._namespace = namespace

        def _resolve(self, name: str) -> str:
            return name if name.startswith("/") else f"{self._namespace}/{name}"

        def create_publisher(self, _: type, topic: str, _qos: Any) -> SimpleNamespace:
            topic = self._resolve(topic)
            return SimpleNamespace(publish=lambda message: sim.publish(topic, message))

        def create_subscription(self, _: type, topic: str, callback: Any, qos: Any) -> None:
            queue: deque[Any] = deque(maxlen=qos.depth)
            sim.subscriptions.setdefault(self._resolve(topic), []).append((queue, callback))

        def create_timer(self, period: float, callback: Callable[[], None]) -> SimpleNamespace:
            return sim.timer(int(period * 1e9), callback)

        def create_client(self, _: type, name: str, **_qos: Any) -> SimpleNamespace:
            name = self._resolve(name)
            return SimpleNamespace(
                call_async=lambda request: sim.call(name, request),
                service_is_ready=lambda: name in sim.services,
            )

        def create_service(self, _: type, name: str, callback: Any, **_qos: Any) -> None:
            sim.services[self._resolve(name)] = callback

        def declare_parameter(self, name: str, default: Any) -> SimpleNamespace:
            return SimpleNamespace(value=sim.parameters.get(name, default))

        def get_clock(self) -> SimpleNamespace:
            return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=sim.now))

        def get_logger(self) -> SimpleNamespace:
            return SimpleNamespace(info=lambda text: sim.logs.append(f"{self.name}: {text}"))

        def destroy_node(self) -> None:
            pass

    contents: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"QoSProfile": SimpleNamespace},
        "rclpy.task": {"Future": SimpleNamespace},
        "std_msgs": {},
        "std_msgs.msg": {"UInt64": SimpleNamespace, "UInt8": SimpleNamespace},
        "std_srvs": {},
        "std_srvs.srv": {"Trigger": SimpleNamespace(Request=SimpleNamespace)},
    }
    modules = {}
    for name, names in contents.items():
        modules[name] = ModuleType(name)
        modules[name].__dict__.update(names)
    return modules


def _loaded_examples() -> list[str]:
    files = {name: getattr(module, "__file__", None) for name, module in sys.modules.items()}
    return [name for name, file in files.items() if file and Path(file).is_relative_to(EXAMPLES)]


@pytest.fixture
def load_example(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], ModuleType]]:
    """Return ``load(folder, module)``: loaded anew for the test, and forgotten after it.

    Another test may have loaded the same module on real ROS, or another one called ``nodes``.
    """
    for name in _loaded_examples():
        monkeypatch.delitem(sys.modules, name)

    def load(folder: str, module: str) -> ModuleType:
        monkeypatch.syspath_prepend(str(EXAMPLES / folder))
        return importlib.import_module(module)

    yield load
    for name in _loaded_examples():
        del sys.modules[name]


@pytest.fixture
def new_sim(monkeypatch: pytest.MonkeyPatch) -> Callable[[], Sim]:
    """Return a function that makes a simulator; examples loaded from then on run on it."""

    def make() -> Sim:
        sim = Sim()
        for name, module in _fake_ros(sim).items():
            monkeypatch.setitem(sys.modules, name, module)
        return sim

    return make


@pytest.fixture
def sim(new_sim: Callable[[], Sim]) -> Sim:
    return new_sim()
