"""A coroutine goes through the robots it knows and waits for each, while another one comes."""

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Int32, String
from std_srvs.srv import Trigger


class Robot(Node):
    """Says hello, and can be asked how it is."""

    def __init__(self):
        super().__init__("robot")
        self.publisher = self.create_publisher(String, "hello", 10)
        self.create_service(Trigger, "~/health", self.health)
        delay = self.declare_parameter("delay", 0.1).value
        self.timer = self.create_timer(delay, self.hello)

    def health(self, request, response):
        response.success = True
        return response

    def hello(self):
        self.timer.cancel()
        self.publisher.publish(String(data=self.get_name()))


class Fleet(Node):
    """Asks all robots how they are."""

    def __init__(self):
        super().__init__("fleet")
        self.robots = {}
        self.group = ReentrantCallbackGroup()
        self.publisher = self.create_publisher(Int32, "healthy", 10)
        self.create_subscription(String, "hello", self.on_hello, 10, callback_group=self.group)
        self.create_timer(0.3, self.ask_all, callback_group=self.group)

    def on_hello(self, message):
        self.robots[message.data] = self.create_client(
            Trigger, f"{message.data}/health", callback_group=self.group
        )

    def known(self):
        return self.robots.values()

    async def ask_all(self):
        healthy = 0
        for client in self.known():
            response = await client.call_async(Trigger.Request())
            healthy += response.success
        self.publisher.publish(Int32(data=healthy))


class CopyingFleet(Fleet):
    """Goes through a copy."""

    def known(self):
        return list(self.robots.values())
