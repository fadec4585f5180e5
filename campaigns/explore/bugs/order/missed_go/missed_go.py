"""A coordinator has a worker prepare, and says go on another topic."""

from rclpy.node import Node
from std_msgs.msg import Empty


class Coordinator(Node):
    """Sends both messages, one after the other."""

    def __init__(self):
        super().__init__("coordinator")
        self.prepare = self.create_publisher(Empty, "prepare", 10)
        self.go = self.create_publisher(Empty, "go", 10)
        self.timer = self.create_timer(0.3, self.begin)

    def begin(self):
        self.timer.cancel()
        self.prepare.publish(Empty())
        self.go.publish(Empty())


class Worker(Node):
    """Works when it is told to go and is prepared."""

    def __init__(self):
        super().__init__("worker")
        self.ready = False
        self.publisher = self.create_publisher(Empty, "done", 10)
        self.create_subscription(Empty, "prepare", self.on_prepare, 10)
        self.create_subscription(Empty, "go", self.on_go, 10)

    def on_prepare(self, message):
        self.ready = True

    def on_go(self, message):
        if self.ready:
            self.publisher.publish(Empty())


class RememberingWorker(Worker):
    """Goes when both have come."""

    told = False

    def on_prepare(self, message):
        self.ready = True
        if self.told:
            self.publisher.publish(Empty())

    def on_go(self, message):
        self.told = True
        super().on_go(message)
