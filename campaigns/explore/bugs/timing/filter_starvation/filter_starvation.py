"""A filter for pairs keeps few images: where one camera lags, none ever finds its partner."""

from collections import deque

from rclpy.node import Node
from std_msgs.msg import Int32


class Camera(Node):
    """Publishes numbered images 20 times per second."""

    def __init__(self):
        super().__init__("camera")
        self.number = 0
        self.publisher = self.create_publisher(Int32, "~/image", 10)
        self.create_timer(0.05, self.tick)

    def tick(self):
        self.number += 1
        self.publisher.publish(Int32(data=self.number))


class Stereo(Node):
    """Makes depth of images of one number."""

    SIZE = 2

    def __init__(self):
        super().__init__("stereo")
        self.queues = (deque(maxlen=self.SIZE), deque(maxlen=self.SIZE))
        self.publisher = self.create_publisher(Int32, "depth", 10)
        for side, name in enumerate(("left", "right")):
            self.create_subscription(
                Int32, f"{name}/image", lambda m, side=side: self.on_image(side, m.data), 10
            )

    def on_image(self, side, number):
        self.queues[side].append(number)
        if number in self.queues[1 - side]:
            self.publisher.publish(Int32(data=number))


class DeepStereo(Stereo):
    """Keeps two seconds of images."""

    SIZE = 40
