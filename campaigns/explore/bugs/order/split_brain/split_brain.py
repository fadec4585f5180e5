"""Robots choose who leads: whoever has heard of nobody leads."""

from rclpy.node import Node
from std_msgs.msg import Int32


class Robot(Node):
    """Claims to lead unless somebody else has."""

    def __init__(self):
        super().__init__("robot")
        self.number = self.declare_parameter("number", 0).value
        self.leader = None
        self.claims = self.create_publisher(Int32, "claim", 10)
        self.follows = self.create_publisher(Int32, "following", 10)
        self.create_subscription(Int32, "claim", self.on_claim, 10)
        self.claim_timer = self.create_timer(0.3, self.claim)
        self.create_timer(0.5, lambda: self.follows.publish(Int32(data=self.leader)))

    def claim(self):
        self.claim_timer.cancel()
        if self.leader is None:
            self.leader = self.number
            self.claims.publish(Int32(data=self.number))

    def on_claim(self, claim):
        if self.leader is None:
            self.leader = claim.data


class YieldingRobot(Robot):
    """Follows the lowest number."""

    def on_claim(self, claim):
        if self.leader is None or claim.data < self.leader:
            self.leader = claim.data


class Observer(Node):
    """Counts leaders."""

    def __init__(self):
        super().__init__("observer")
        self.leaders = set()
        self.publisher = self.create_publisher(Int32, "leaders", 10)
        self.create_subscription(Int32, "following", self.on_following, 10)

    def on_following(self, message):
        self.leaders.add(message.data)
        self.publisher.publish(Int32(data=len(self.leaders)))
