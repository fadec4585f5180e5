"""A mode is set as a parameter, and the command that needs it is sent right behind."""

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_msgs.msg import Empty, String


class Gripper(Node):
    """Grips as hard as its mode says."""

    def __init__(self):
        super().__init__("gripper")
        self.declare_parameter("mode", "hard")
        self.publisher = self.create_publisher(String, "gripped", 10)
        self.create_subscription(Empty, "grip", self.on_grip, 10)

    def on_grip(self, message):
        self.publisher.publish(String(data=self.get_parameter("mode").value))


class Commander(Node):
    """Has an egg gripped."""

    def __init__(self):
        super().__init__("commander")
        self.client = AsyncParameterClient(self, "gripper")
        self.publisher = self.create_publisher(Empty, "grip", 10)
        self.timer = self.create_timer(0.3, self.command)

    def set_mode(self):
        self.timer.cancel()
        return self.client.set_parameters([Parameter("mode", Parameter.Type.STRING, "soft")])

    def command(self):
        self.set_mode()
        self.publisher.publish(Empty())


class WaitingCommander(Commander):
    """Commands when the mode is set."""

    def command(self):
        self.set_mode().add_done_callback(lambda done: self.publisher.publish(Empty()))
