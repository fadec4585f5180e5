"""Mains that number what they send, and write down what they have sent and got."""

import json
import os
import signal
import sys
import threading
import time
from collections import Counter
from itertools import count as count_from
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String, UInt64

DEPTH = 10_000
"""Nobody loses a message, however long it is not its turn."""
ENOUGH = 21


def all_heard(progress: Any) -> bool:
    """End a run when each of four nodes that count has heard enough of each."""
    return all(Path(f"{number}.heard").exists() for number in range(1, 5))


class Counting(Node):
    """Publishes numbers on ``out`` and a text that all others of its kind publish, too, and counts
    all that it does and gets."""

    def __init__(self, name: str, first: int = 0) -> None:
        super().__init__(name)
        self.first = self.next = self.declare_parameter("first", first).value
        self.got: list[int] = []
        self.of_each: Counter[int] = Counter()
        self.same = 0
        self.out = self.create_publisher(UInt64, "/numbers", DEPTH)
        self.say = self.create_publisher(String, "/same", DEPTH)
        self.create_subscription(UInt64, "/numbers", self.on_number, DEPTH)
        self.create_subscription(String, "/same", self.on_same, DEPTH)
        self.create_timer(self.declare_parameter("period", 0.01).value, self.on_timer)
        self.told = self.declare_parameter("told", "").value

    def on_timer(self) -> None:
        self.out.publish(UInt64(data=self.next))
        self.say.publish(String(data="the same"))
        self.next += 1

    def on_number(self, message: UInt64) -> None:
        self.got.append(message.data)
        self.of_each[message.data // 100_000] += 1
        if len(self.of_each) == 4 and min(self.of_each.values()) == ENOUGH:
            Path(f"{self.first // 100_000}.heard").touch()

    def on_same(self, message: String) -> None:
        self.same += 1

    def destroy_node(self) -> None:
        """Write down what it has counted, if it is to be told."""
        if self.told:
            Path(self.told).write_text(json.dumps(self.counted()))
        super().destroy_node()

    def counted(self) -> dict[str, Any]:
        return {"sent": self.next - self.first, "got": self.got, "same": self.same}


def count() -> None:
    """Spin a node that counts; the argument is where to write what it counted."""
    rclpy.init()
    node = Counting("counting")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        Path(sys.argv[1]).write_text(json.dumps(node.counted()))
        end(node)


def end(node: Node) -> None:
    """End properly: Fast DDS crashes now and then if a program ends while it has nodes."""
    node.destroy_node()
    rclpy.try_shutdown()


def talk() -> None:
    """Publish in a loop, without a spin."""
    rclpy.init()
    node = Node("talk")
    publisher = node.create_publisher(UInt64, "/numbers", 100)
    for number in range(int(sys.argv[1])):
        publisher.publish(UInt64(data=number))
        time.sleep(0.05)
    end(node)


def crash() -> None:
    """Be killed in the middle of something, once somebody says /same."""
    rclpy.init()
    node, heard = Node("crash"), []
    node.create_publisher(String, "/last_words", 10).publish(String(data="farewell"))
    node.create_subscription(String, "/same", heard.append, 10)
    while not heard:
        rclpy.spin_once(node)
    os.kill(os.getpid(), signal.SIGSEGV)


def crash_at_end() -> None:
    """Publish numbers that begin with an argument, and be killed as it ends: after ``spin``, in
    ``destroy`` of its node after another number, in the ``shutdown`` that it calls itself, or at
    the ``exit`` of Python. A file says what it has published."""
    name, where = sys.argv[1:]
    numbers, sent = count_from(int(name) * 100_000), []

    class Late:
        def __del__(self, kill: Any = os.kill, pid: int = os.getpid()) -> None:
            kill(pid, 11)  # there is no module any more

    class Crashing(Node):
        def destroy_node(self) -> None:
            end()

    def publish() -> None:
        out.publish(UInt64(data=(number := next(numbers))))
        sent.append(number)
        if len(sent) == ENOUGH:
            Path(f"{name}.heard").touch()
            if where == "shutdown":
                rclpy.get_default_context().on_shutdown(end)
                rclpy.shutdown()

    def end() -> None:
        Path(name).write_text(json.dumps(sent))
        if where == "exit":
            sys.late = Late()  # type: ignore[attr-defined]
        else:
            os.kill(os.getpid(), signal.SIGSEGV)

    # rclpy's handlers shut down, and publishing fails from then on.
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = Crashing(f"crash_{name}")
    out = node.create_publisher(UInt64, "/numbers", DEPTH)
    node.create_timer(0.02, publish)  # it is hardly ever interrupted in the middle of it
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    if where == "destroy":
        publish()
        node.destroy_node()
    end()


def fork() -> None:
    """Fork, and be a node in both processes."""
    copy = os.fork()
    rclpy.init()
    node = Node("fork")
    publisher = node.create_publisher(UInt64, "/numbers", 10)
    publisher.publish(UInt64(data=copy == 0))
    time.sleep(0.1)
    if copy:
        os.waitpid(copy, 0)
    end(node)


def become() -> None:
    """Become another program."""
    rclpy.init()
    Node("become")
    os.execvp("true", ["true"])


def fail() -> None:
    rclpy.init()
    Node("fail")
    raise ValueError("of the main")


def deaf() -> None:
    """Ignore whoever asks it to end."""
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    Node("deaf").create_publisher(String, "/deaf", 10).publish(String())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Path(sys.argv[1]).write_text(str(os.getpid()))
    threading.Event().wait()
