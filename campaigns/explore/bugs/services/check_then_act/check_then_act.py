"""Two cells look whether the machine is free, and start it if it is."""

from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger


class Machine(Node):
    """Runs one part at a time."""

    def __init__(self):
        super().__init__("machine")
        self.parts = 0
        self.publisher = self.create_publisher(Int32, "parts", 10)
        self.create_service(Trigger, "is_free", self.is_free)
        self.create_service(Trigger, "start", self.start)

    def is_free(self, request, response):
        response.success = self.parts == 0
        return response

    def start(self, request, response):
        self.parts += 1
        self.publisher.publish(Int32(data=self.parts))
        response.success = True
        return response


class TestAndSetMachine(Machine):
    """Refuses a second part."""

    def start(self, request, response):
        if self.parts == 0:
            return super().start(request, response)
        response.success = False
        return response


class Cell(Node):
    """Has a part."""

    def __init__(self):
        super().__init__("cell")
        self.ask = self.create_client(Trigger, "is_free")
        self.start = self.create_client(Trigger, "start")
        self.timer = self.create_timer(0.3, self.look)

    def look(self):
        self.timer.cancel()
        self.ask.call_async(Trigger.Request()).add_done_callback(self.on_answer)

    def on_answer(self, future):
        if future.result().success:
            self.start.call_async(Trigger.Request())
