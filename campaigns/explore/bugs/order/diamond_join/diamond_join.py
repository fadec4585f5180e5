"""An image takes two ways, and who joins them believes the last to come belong together."""

from geometry_msgs.msg import Point
from rclpy.node import Node
from std_msgs.msg import Int32


class Camera(Node):
    """Publishes numbered images."""

    def __init__(self):
        super().__init__("camera")
        self.number = 0
        self.publisher = self.create_publisher(Int32, "image", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.number += 1
        self.publisher.publish(Int32(data=self.number))


class Detector(Node):
    """Finds boxes in an image."""

    def __init__(self):
        super().__init__("detector")
        self.publisher = self.create_publisher(Int32, "boxes", 10)
        self.create_subscription(Int32, "image", self.publisher.publish, 10)


class Segmenter(Node):
    """Finds the floor in an image."""

    def __init__(self):
        super().__init__("segmenter")
        self.publisher = self.create_publisher(Int32, "floor", 10)
        self.create_subscription(Int32, "image", self.publisher.publish, 10)


class Fuser(Node):
    """Puts the boxes of an image on its floor."""

    def __init__(self):
        super().__init__("fuser")
        self.boxes = Int32()
        self.publisher = self.create_publisher(Point, "fused", 10)
        self.create_subscription(Int32, "boxes", self.on_boxes, 10)
        self.create_subscription(Int32, "floor", self.on_floor, 10)

    def on_boxes(self, boxes):
        self.boxes = boxes

    def on_floor(self, floor):
        self.fuse(self.boxes.data, floor.data)

    def fuse(self, boxes, floor):
        self.publisher.publish(Point(x=float(boxes), y=float(floor)))


class MatchingFuser(Fuser):
    """Fuses what is of one image."""

    def __init__(self):
        self.seen = set()
        super().__init__()

    def on_boxes(self, boxes):
        self.match(boxes.data)

    def on_floor(self, floor):
        self.match(floor.data)

    def match(self, number):
        if number in self.seen:
            self.fuse(number, number)
        self.seen.add(number)
