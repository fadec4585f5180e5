"""Two robots need the lift and the door, and take them one after the other."""

from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger


class Resource(Node):
    """Belongs to one at a time."""

    def __init__(self):
        super().__init__("resource")
        self.taken = False
        self.create_service(Trigger, "~/take", self.take)
        self.create_service(Trigger, "~/give_back", self.give_back)

    def take(self, request, response):
        response.success = not self.taken
        self.taken = True
        return response

    def give_back(self, request, response):
        self.taken = False
        return response


class Robot(Node):
    """Takes what it needs, in the order of its parameter, and tries again where it is refused."""

    def __init__(self):
        super().__init__("robot")
        self.needs = list(self.declare_parameter("needs", [""]).value)
        self.held = 0
        self.takes = {name: self.create_client(Trigger, f"{name}/take") for name in self.needs}
        self.gives = {name: self.create_client(Trigger, f"{name}/give_back") for name in self.needs}
        self.publisher = self.create_publisher(Int32, "arrived", 10)
        self.timer = self.create_timer(0.1, self.take_next)

    def take_next(self):
        self.timer.cancel()
        name = self.needs[self.held]
        self.takes[name].call_async(Trigger.Request()).add_done_callback(self.on_answer)

    def on_answer(self, future):
        if not future.result().success:
            self.timer.reset()
            return
        self.held += 1
        if self.held < len(self.needs):
            self.take_next()
            return
        self.publisher.publish(Int32(data=1))
        for client in self.gives.values():
            client.call_async(Trigger.Request())


class Counter(Node):
    """Counts who has arrived."""

    def __init__(self):
        super().__init__("counter")
        self.total = 0
        self.publisher = self.create_publisher(Int32, "all_arrived", 10)
        self.create_subscription(Int32, "arrived", self.on_arrived, 10)

    def on_arrived(self, message):
        self.total += message.data
        if self.total == 2:
            self.publisher.publish(message)
