"""A map is published once; who subscribes a moment later never sees it."""

from nav_msgs.msg import OccupancyGrid, Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Empty

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Manager(Node):
    """Activates the others."""

    def __init__(self):
        super().__init__("manager")
        self.publisher = self.create_publisher(Empty, "activate", 10)
        self.timer = self.create_timer(0.3, self.activate)

    def activate(self):
        self.timer.cancel()
        self.publisher.publish(Empty())


class MapServer(Node):
    """Publishes the map when it is loaded."""

    QOS = QoSProfile(depth=1)

    def __init__(self):
        super().__init__("map_server")
        self.publisher = self.create_publisher(OccupancyGrid, "map", self.QOS)
        self.timer = self.create_timer(0.3, self.loaded)

    def loaded(self):
        self.timer.cancel()
        self.publisher.publish(OccupancyGrid())


class Planner(Node):
    """Plans as soon as it is active and has the map."""

    QOS = QoSProfile(depth=1)

    def __init__(self):
        super().__init__("planner")
        self.publisher = self.create_publisher(Path, "path", 10)
        self.create_subscription(Empty, "activate", self.on_activate, 10)

    def on_activate(self, message):
        self.create_subscription(OccupancyGrid, "map", self.on_map, self.QOS)

    def on_map(self, grid):
        self.publisher.publish(Path(header=grid.header))


class LatchingMapServer(MapServer):
    """Keeps the map for those who come later."""

    QOS = LATCHED


class LatePlanner(Planner):
    """Asks for what was published before."""

    QOS = LATCHED
