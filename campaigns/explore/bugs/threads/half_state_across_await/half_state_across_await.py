"""A reentrant callback writes x, waits, and writes y; another one reads both."""

from geometry_msgs.msg import Point
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Float64
from test_msgs.srv import BasicTypes


class Converter(Node):
    """Converts a coordinate."""

    def __init__(self):
        super().__init__("converter")
        self.create_service(BasicTypes, "convert", self.convert)

    def convert(self, request, response):
        response.float64_value = request.float64_value
        return response


class Source(Node):
    """Publishes a coordinate that both axes are to have."""

    def __init__(self):
        super().__init__("source")
        self.value = 0.0
        self.publisher = self.create_publisher(Float64, "coordinate", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.value += 1.0
        self.publisher.publish(Float64(data=self.value))


class Tracker(Node):
    """Publishes the pose ten times per second."""

    def __init__(self):
        super().__init__("tracker")
        self.pose = Point()
        group = ReentrantCallbackGroup()
        self.client = self.create_client(
            BasicTypes, "convert", callback_group=MutuallyExclusiveCallbackGroup()
        )
        self.publisher = self.create_publisher(Point, "pose", 10)
        self.create_subscription(
            Float64, "coordinate", self.on_coordinate, 10, callback_group=group
        )
        self.create_timer(0.1, lambda: self.publisher.publish(self.pose), callback_group=group)

    async def on_coordinate(self, message):
        self.pose.x = message.data
        response = await self.client.call_async(BasicTypes.Request(float64_value=message.data))
        self.pose.y = response.float64_value


class WholeTracker(Tracker):
    """Writes both when it has both."""

    async def on_coordinate(self, message):
        response = await self.client.call_async(BasicTypes.Request(float64_value=message.data))
        self.pose.x, self.pose.y = message.data, response.float64_value
