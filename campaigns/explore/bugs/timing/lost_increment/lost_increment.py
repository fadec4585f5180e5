"""A door is told when somebody comes in and when somebody leaves, over a link that loses."""

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32


class Door(Node):
    """Somebody comes in, somebody leaves, again and again; reports people inside."""

    RELIABILITY = ReliabilityPolicy.BEST_EFFORT

    def __init__(self):
        super().__init__("door")
        self.step = 1
        qos = QoSProfile(depth=10, reliability=self.RELIABILITY)
        self.publisher = self.create_publisher(Int32, "passed", qos)
        self.create_timer(0.05, self.tick)

    def tick(self):
        self.publisher.publish(Int32(data=self.step))
        self.step = -self.step


class Room(Node):
    """Counts who is inside."""

    RELIABILITY = ReliabilityPolicy.BEST_EFFORT

    def __init__(self):
        super().__init__("room")
        self.inside = 0
        self.publisher = self.create_publisher(Int32, "inside", 10)
        qos = QoSProfile(depth=10, reliability=self.RELIABILITY)
        self.create_subscription(Int32, "passed", self.on_passed, qos)

    def on_passed(self, passed):
        self.inside += passed.data
        self.publisher.publish(Int32(data=self.inside))


class ReliableDoor(Door):
    """Sends again what was lost."""

    RELIABILITY = ReliabilityPolicy.RELIABLE


class ReliableRoom(Room):
    """Asks again for what was lost."""

    RELIABILITY = ReliabilityPolicy.RELIABLE
