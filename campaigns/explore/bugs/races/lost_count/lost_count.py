"""Two belts count their parts at once: each reads the count, adds one, and writes it back."""

import threading

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int32


class Belts(Node):
    """Two belts bring a part each, five times."""

    def __init__(self):
        super().__init__("belts")
        self.parts = 0
        self.belts = [self.create_publisher(Int32, f"belt{side}", 10) for side in "ab"]
        self.timer = self.create_timer(0.1, self.bring)

    def bring(self):
        self.parts += 1
        for belt in self.belts:
            belt.publish(Int32(data=1))
        if self.parts == 5:
            self.timer.cancel()


class Counter(Node):
    """Counts the parts of both belts in one reentrant group, and says twice a second how many."""

    def __init__(self):
        super().__init__("counter")
        self.count = 0
        self.publisher = self.create_publisher(Int32, "count", 10)
        group = ReentrantCallbackGroup()
        for side in "ab":
            self.create_subscription(Int32, f"belt{side}", self.on_part, 10, callback_group=group)
        self.create_timer(0.55, lambda: self.publisher.publish(Int32(data=self.count)))

    def on_part(self, part):
        count = self.count + part.data
        self.count = count


class LockedCounter(Counter):
    """Counts under a lock."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()

    def on_part(self, part):
        with self.lock:
            super().on_part(part)


def spin(kind):
    rclpy.init()
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(kind())
    executor.spin()


def main():
    spin(Counter)


def locked_main():
    spin(LockedCounter)
