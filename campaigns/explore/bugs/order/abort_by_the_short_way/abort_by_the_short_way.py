"""An abort has one hop to go and the order five: surely it is always there first."""

from rclpy.node import Node
from std_msgs.msg import Bool, Empty


class Operator(Node):
    """Orders, and takes it back at once."""

    def __init__(self):
        super().__init__("operator")
        self.orders = self.create_publisher(Empty, "step0", 10)
        self.aborts = self.create_publisher(Empty, "abort", 10)
        self.timer = self.create_timer(0.3, self.decide)

    def decide(self):
        self.timer.cancel()
        self.orders.publish(Empty())
        self.aborts.publish(Empty())


class Step(Node):
    """One step of planning."""

    def __init__(self):
        super().__init__("step")
        number = self.declare_parameter("number", 0).value
        self.publisher = self.create_publisher(Empty, f"step{number + 1}", 10)
        self.create_subscription(Empty, f"step{number}", self.publisher.publish, 10)


class Gripper(Node):
    """Grips unless it was told not to."""

    def __init__(self):
        super().__init__("gripper")
        self.aborted = False
        self.publisher = self.create_publisher(Bool, "grip", 10)
        self.create_subscription(Empty, "abort", self.on_abort, 10)
        self.create_subscription(Empty, "step4", self.on_order, 10)

    def on_abort(self, message):
        self.aborted = True

    def on_order(self, message):
        self.grip()

    def grip(self):
        if not self.aborted:
            self.publisher.publish(Bool(data=True))


class WaitingGripper(Gripper):
    """Leaves the operator a moment."""

    def on_order(self, message):
        self.timer = self.create_timer(0.1, self.after_a_moment)

    def after_a_moment(self):
        self.timer.cancel()
        self.grip()
