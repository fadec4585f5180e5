"""A rover whose wheel odometry comes over a bus that sometimes has to ask twice.

``WheelDriver`` waits for the bus inside its callback, and how long that takes is not in the
program. Now and then the odometry is late, and the pose is published without it.
"""

import math
import os
import random
import time

from geometry_msgs.msg import Pose2D
from nav_msgs.msg import Odometry
from rclpy.node import Node

ANSWER_S = 0.002
RETRY_S = 0.015


class Bus:
    """Stands for hardware: answers in 2 ms, or after a retry in 17 ms.

    Without BUS_SEED it is different in every run, as the real one is; the samples are made with
    two seeds so that they can be made again.
    """

    def __init__(self):
        self.chance = random.Random(os.environ.get("BUS_SEED"))

    def ask(self):
        retry = self.chance.random() < 0.02
        time.sleep(ANSWER_S + (RETRY_S if retry else 0.0))


class WheelDriver(Node):
    """Reads the wheels 25 times a second."""

    def __init__(self):
        super().__init__("wheel_driver")
        self.odometry = self.create_publisher(Odometry, "odom", 10)
        self.bus = Bus()
        self.create_timer(0.04, self.read)

    def read(self):
        stamp = self.get_clock().now()
        self.bus.ask()
        seconds = stamp.nanoseconds / 1e9
        message = Odometry(child_frame_id="base_link")
        message.header.frame_id = "odom"
        message.header.stamp = stamp.to_msg()
        message.twist.twist.linear.x = 0.4
        message.twist.twist.angular.z = 0.3 * math.sin(seconds)
        self.odometry.publish(message)


class Localizer(Node):
    """Integrates the odometry and publishes a pose 10 ms after every reading should be there."""

    def __init__(self):
        super().__init__("localizer")
        self.poses = self.create_publisher(Pose2D, "pose", 10)
        self.pose = Pose2D()
        self.velocity = (0.0, 0.0)
        self.create_subscription(Odometry, "odom", self.on_odometry, 10)
        self.create_timer(0.01, self.step)

    def on_odometry(self, message):
        self.velocity = (message.twist.twist.linear.x, message.twist.twist.angular.z)

    def step(self):
        forward, turn = self.velocity
        self.pose.theta += 0.01 * turn
        self.pose.x += 0.01 * forward * math.cos(self.pose.theta)
        self.pose.y += 0.01 * forward * math.sin(self.pose.theta)
        self.poses.publish(self.pose)
