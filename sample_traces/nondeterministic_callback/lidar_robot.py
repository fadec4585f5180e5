"""A small robot that keeps away from what its lidar sees.

The bug is in ``ObstacleFilter.on_scan``: it sums over a set. Sets of strings iterate in another
order in every Python process, and floating point addition is not associative.
"""

import math

from geometry_msgs.msg import Twist, Vector3
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

BEAMS = 36
SECTORS = ("front", "front_left", "left", "rear_left", "rear", "rear_right", "right", "front_right")


class Lidar(Node):
    """Ten scans a second of a room into which a second and a third obstacle move."""

    def __init__(self):
        super().__init__("lidar")
        self.scans = self.create_publisher(LaserScan, "scan", 10)
        self.count = 0
        self.create_timer(0.1, self.scan)

    def scan(self):
        self.count += 1
        message = LaserScan(
            angle_min=0.0,
            angle_max=math.tau * (BEAMS - 1) / BEAMS,
            angle_increment=math.tau / BEAMS,
            range_min=0.1,
            range_max=8.0,
            ranges=[self.range_at(beam) for beam in range(BEAMS)],
        )
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "lidar"
        self.scans.publish(message)

    def range_at(self, beam):
        obstacles = [(4, 2.5)]
        if self.count > 12:
            obstacles.append((15, 3.1))
        if self.count > 20:
            obstacles.append((28, 1.7))
        for centre, distance in obstacles:
            if abs(beam - centre) <= 1:
                return distance + 0.01 * math.sin(self.count + beam)
        return 8.0


class ObstacleFilter(Node):
    """Turns a scan into one vector that points away from all obstacles."""

    def __init__(self):
        super().__init__("obstacle_filter")
        self.push = self.create_publisher(Vector3, "push", 10)
        self.create_subscription(LaserScan, "scan", self.on_scan, 10)

    def on_scan(self, scan):
        nearest = {}
        for beam, distance in enumerate(scan.ranges):
            if distance < 5.0:
                sector = SECTORS[beam * len(SECTORS) // BEAMS]
                nearest[sector] = min(nearest.get(sector, math.inf), distance)
        x = y = 0.0
        for sector in set(nearest):  # the bug: sorted(nearest) would always sum in one order
            angle = math.tau * SECTORS.index(sector) / len(SECTORS)
            x -= math.cos(angle) / nearest[sector] ** 2
            y -= math.sin(angle) / nearest[sector] ** 2
        self.push.publish(Vector3(x=x, y=y))


class Driver(Node):
    """Drives forward and yields to the push."""

    def __init__(self):
        super().__init__("driver")
        self.commands = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Vector3, "push", self.on_push, 10)

    def on_push(self, push):
        command = Twist()
        command.linear.x = max(0.5 + push.x, 0.0)
        command.angular.z = 2.0 * push.y
        self.commands.publish(command)
