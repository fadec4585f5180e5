"""A node looks once whether a service is there, which another node is about to offer."""

from nav_msgs.msg import Path
from nav_msgs.srv import GetMap
from rclpy.node import Node
from std_msgs.msg import Empty


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
    """Offers the map once it is active."""

    def __init__(self):
        super().__init__("map_server")
        self.create_subscription(Empty, "activate", self.on_activate, 10)

    def on_activate(self, message):
        self.create_service(GetMap, "get_map", lambda request, response: response)


class Planner(Node):
    """Fetches the map when it becomes active."""

    def __init__(self):
        super().__init__("planner")
        self.client = self.create_client(GetMap, "get_map")
        self.publisher = self.create_publisher(Path, "path", 10)
        self.create_subscription(Empty, "activate", self.on_activate, 10)

    def on_activate(self, message):
        if not self.client.service_is_ready():
            self.get_logger().error("there is no map server")
            return
        self.fetch()

    def fetch(self):
        future = self.client.call_async(GetMap.Request())
        future.add_done_callback(lambda done: self.publisher.publish(Path()))


class RetryingPlanner(Planner):
    """Looks again."""

    def on_activate(self, message):
        self.timer = self.create_timer(0.05, self.look)

    def look(self):
        if self.client.service_is_ready():
            self.timer.cancel()
            self.fetch()
