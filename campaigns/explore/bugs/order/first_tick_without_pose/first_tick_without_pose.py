"""A controller takes for granted that a pose has come before its first tick."""

from geometry_msgs.msg import Point, Twist
from rclpy.node import Node


class Odometry(Node):
    """Publishes where the robot is."""

    def __init__(self):
        super().__init__("odometry")
        self.x = 0.0
        self.publisher = self.create_publisher(Point, "pose", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.x += 0.1
        self.publisher.publish(Point(x=self.x))


class Controller(Node):
    """Drives to x = 1."""

    def __init__(self):
        super().__init__("controller")
        self.pose = None
        self.publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Point, "pose", self.on_pose, 10)
        self.create_timer(0.1, self.tick)

    def on_pose(self, pose):
        self.pose = pose

    def tick(self):
        command = Twist()
        command.linear.x = 1.0 - self.pose.x
        self.publisher.publish(command)


class CarefulController(Controller):
    """Waits for the first pose."""

    def tick(self):
        if self.pose is not None:
            super().tick()
