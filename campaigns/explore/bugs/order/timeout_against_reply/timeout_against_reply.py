"""A reply comes at the moment at which nobody waits for it any more."""

from rclpy.node import Node
from std_msgs.msg import Int32


class Server(Node):
    """Answers ten times per second what has been asked."""

    def __init__(self):
        super().__init__("server")
        self.asked = []
        self.publisher = self.create_publisher(Int32, "reply", 10)
        self.create_subscription(Int32, "request", self.asked.append, 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        for request in self.asked:
            self.publisher.publish(request)
        self.asked.clear()


class Client(Node):
    """Asks, and gives up after a tenth of a second."""

    def __init__(self):
        super().__init__("client")
        self.pending = None
        self.publisher = self.create_publisher(Int32, "request", 10)
        self.results = self.create_publisher(Int32, "result", 10)
        self.create_subscription(Int32, "reply", self.on_reply, 10)
        self.ask_timer = self.create_timer(0.3, self.ask)

    def ask(self):
        self.ask_timer.cancel()
        self.pending = Int32(data=7)
        self.publisher.publish(self.pending)
        self.timeout = self.create_timer(0.1, self.give_up)

    def give_up(self):
        self.timeout.cancel()
        self.pending = None
        self.results.publish(Int32(data=-1))

    def on_reply(self, reply):
        self.timeout.cancel()
        self.results.publish(Int32(data=self.pending.data + reply.data))
        self.pending = None


class CalmClient(Client):
    """Ignores what it no longer waits for."""

    def on_reply(self, reply):
        if self.pending is not None:
            super().on_reply(reply)
