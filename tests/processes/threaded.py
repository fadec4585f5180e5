"""A node with threads of its own, locks, sleeps and chance, for test_threaded_nodes.py."""

import random
import secrets
import threading
import time

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String


class Threaded(Node):
    def __init__(self) -> None:
        super().__init__("threaded")
        self.out = self.create_publisher(String, "said", 10)
        group = ReentrantCallbackGroup()
        for _ in range(2):
            self.create_timer(0.1, self.slow, callback_group=group)
        self.changed = threading.Condition()
        self.count = 0
        for work in (self.work, self.watch):
            threading.Thread(target=work, daemon=True).start()

    def say(self, text: str) -> None:
        self.out.publish(String(data=f"{time.time():.3f} {text}"))

    def slow(self) -> None:
        self.say("slow begins")
        time.sleep(0.05)
        with self.changed:
            self.count += 1
            self.changed.notify_all()
        self.say("slow ends")

    def work(self) -> None:
        for _ in range(8):
            time.sleep(random.random() / 10)
            self.say(f"work {secrets.token_hex(4)}")

    def watch(self) -> None:
        while rclpy.ok():
            with self.changed:
                self.changed.wait_for(lambda: self.count >= 2, timeout=0.07)
                count, self.count = self.count, 0
            self.say(f"watch {count}")


def main() -> None:
    rclpy.init()
    executor = MultiThreadedExecutor(3)
    executor.add_node(Threaded())
    executor.spin()


if __name__ == "__main__":
    main()
