"""A logger empties its batch when the storage has answered, and what came meanwhile with it."""

from rclpy.node import Node
from std_msgs.msg import Int32
from test_msgs.srv import BasicTypes


class Sensor(Node):
    """Takes twelve samples."""

    def __init__(self):
        super().__init__("sensor")
        self.count = 0
        self.publisher = self.create_publisher(Int32, "sample", 50)
        self.timer = self.create_timer(0.05, self.tick)

    def tick(self):
        self.count += 1
        self.publisher.publish(Int32(data=self.count))
        if self.count == 12:
            self.timer.cancel()


class Storage(Node):
    """Says how many samples it has stored."""

    def __init__(self):
        super().__init__("storage")
        self.total = 0
        self.publisher = self.create_publisher(Int32, "stored", 10)
        self.create_service(BasicTypes, "store", self.store)

    def store(self, request, response):
        self.total += request.int32_value
        self.publisher.publish(Int32(data=self.total))
        return response


class Logger(Node):
    """Stores samples in batches."""

    def __init__(self):
        super().__init__("logger")
        self.batch = []
        self.client = self.create_client(BasicTypes, "store")
        self.create_subscription(Int32, "sample", lambda m: self.batch.append(m.data), 50)
        self.create_timer(0.2, self.flush)

    def flush(self):
        future = self.client.call_async(BasicTypes.Request(int32_value=len(self.batch)))
        future.add_done_callback(lambda done: self.batch.clear())


class SwappingLogger(Logger):
    """Begins a new batch with the request."""

    def flush(self):
        self.client.call_async(BasicTypes.Request(int32_value=len(self.batch)))
        self.batch.clear()
