"""A cache is emptied when the value changes, and filled by the answer to an earlier question."""

from rclpy.node import Node
from std_msgs.msg import Empty, Int32
from test_msgs.srv import BasicTypes


class Database(Node):
    """Knows a value, which is written once."""

    def __init__(self):
        super().__init__("database")
        self.value = 1
        self.changed = self.create_publisher(Empty, "changed", 10)
        self.create_service(BasicTypes, "get", self.get)
        self.create_subscription(Int32, "write", self.on_write, 10)

    def get(self, request, response):
        response.int32_value = self.value
        return response

    def on_write(self, message):
        self.value = message.data
        self.changed.publish(Empty())


class Writer(Node):
    """Writes a 2."""

    def __init__(self):
        super().__init__("writer")
        self.publisher = self.create_publisher(Int32, "write", 10)
        self.timer = self.create_timer(0.15, self.write)

    def write(self):
        self.timer.cancel()
        self.publisher.publish(Int32(data=2))


class Display(Node):
    """Shows the value, and asks for it when it does not know it."""

    def __init__(self):
        super().__init__("display")
        self.value = None
        self.client = self.create_client(BasicTypes, "get")
        self.publisher = self.create_publisher(Int32, "shown", 10)
        self.create_subscription(Empty, "changed", self.on_changed, 10)
        self.create_timer(0.1, self.tick)

    def on_changed(self, message):
        self.value = None

    def tick(self):
        if self.value is None:
            self.client.call_async(BasicTypes.Request()).add_done_callback(self.on_value)
        else:
            self.publisher.publish(Int32(data=self.value))

    def on_value(self, future):
        self.value = future.result().int32_value


class ForgettingDisplay(Display):
    """Does not keep an answer to a question from before the change."""

    changes = 0

    def on_changed(self, message):
        self.changes += 1
        super().on_changed(message)

    def tick(self):
        if self.value is not None:
            super().tick()
            return
        asked_at = self.changes
        future = self.client.call_async(BasicTypes.Request())
        future.add_done_callback(lambda done: self.changes == asked_at and self.on_value(done))
