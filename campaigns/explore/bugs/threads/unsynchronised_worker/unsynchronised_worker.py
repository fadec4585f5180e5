"""A thread takes a job from a list while a callback changes the list, without a lock."""

import random
import threading
import time

from rclpy.node import Node
from std_msgs.msg import Int32


class Source(Node):
    """Publishes ten jobs."""

    def __init__(self):
        super().__init__("source")
        self.number = 0
        self.publisher = self.create_publisher(Int32, "job", 20)
        self.timer = self.create_timer(0.05, self.tick)

    def tick(self):
        self.number += 1
        self.publisher.publish(Int32(data=self.number))
        if self.number == 10:
            self.timer.cancel()


class Pool(Node):
    """Works on the newest job in a thread, and says how many are done."""

    def __init__(self):
        super().__init__("pool")
        self.done = 0
        self.publisher = self.create_publisher(Int32, "done", 20)
        self.create_subscription(Int32, "job", self.on_job, 20)

    def on_job(self, job):
        threading.Thread(target=self.work, daemon=True).start()

    def work(self):
        done = self.done
        time.sleep(random.uniform(0.01, 0.0505))  # the work
        self.done = done + 1
        self.publisher.publish(Int32(data=self.done))


class LockedPool(Pool):
    """Counts under a lock."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()

    def work(self):
        time.sleep(random.uniform(0.01, 0.0505))
        with self.lock:
            self.done += 1
            self.publisher.publish(Int32(data=self.done))
