"""Three robots mark their cell on a map that they share: read, change, publish."""

from rclpy.node import Node
from std_msgs.msg import Int32MultiArray


class Mapper(Node):
    """Marks one cell of the map."""

    def __init__(self):
        super().__init__("mapper")
        self.cell = self.declare_parameter("cell", 0).value
        self.map = [0, 0, 0]
        self.publisher = self.create_publisher(Int32MultiArray, "map", 10)
        self.create_subscription(Int32MultiArray, "map", self.on_map, 10)
        self.timer = self.create_timer(0.5, self.mark)

    def on_map(self, message):
        self.map = list(message.data)

    def mark(self):
        self.timer.cancel()
        self.map[self.cell] = 1
        self.publisher.publish(Int32MultiArray(data=self.map))


class MergingMapper(Mapper):
    """Adds what it knows to what it hears."""

    def on_map(self, message):
        self.map = [max(mine, theirs) for mine, theirs in zip(self.map, message.data, strict=True)]
        if self.map != list(message.data):
            self.publisher.publish(Int32MultiArray(data=self.map))
