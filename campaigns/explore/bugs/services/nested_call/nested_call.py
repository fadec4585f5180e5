"""Two arms ask each other, within their service callbacks, for leave to move."""

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger


class Arm(Node):
    """Moves when asked, with the other arm's leave."""

    def __init__(self):
        super().__init__("arm")
        other = self.declare_parameter("other", "").value
        self.publisher = self.create_publisher(String, "moved", 10)
        self.clients_group = MutuallyExclusiveCallbackGroup()
        self.leave = self.create_client(
            Trigger, f"/{other}/leave", callback_group=self.clients_group
        )
        self.make_service()
        self.timer = self.create_timer(0.3, self.move)

    def make_service(self):
        # In the group of the timer, which waits for an answer.
        self.create_service(Trigger, "~/leave", self.give_leave)

    def give_leave(self, request, response):
        response.success = True
        return response

    def move(self):
        self.timer.cancel()
        if self.leave.call(Trigger.Request()).success:
            self.publisher.publish(String(data=self.get_name()))


class PoliteArm(Arm):
    """Gives leave while it waits."""

    def make_service(self):
        self.create_service(
            Trigger,
            "~/leave",
            self.give_leave,
            callback_group=MutuallyExclusiveCallbackGroup(),
        )


class Counter(Node):
    """Counts the arms that have moved."""

    def __init__(self):
        super().__init__("counter")
        self.names = set()
        self.create_subscription(String, "moved", self.on_moved, 10)
        self.publisher = self.create_publisher(String, "all_moved", 10)

    def on_moved(self, message):
        self.names.add(message.data)
        if len(self.names) == 2:
            self.publisher.publish(String())
