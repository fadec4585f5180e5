"""A managed node is cleaned up while an image waits for it."""

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from std_msgs.msg import Int32


class Camera(Node):
    """Publishes images."""

    def __init__(self):
        super().__init__("camera")
        self.number = 0
        self.publisher = self.create_publisher(Int32, "image", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        self.number += 1
        self.publisher.publish(Int32(data=self.number))


class Detector(LifecycleNode):
    """Holds its network from configuring to cleaning up."""

    def __init__(self):
        super().__init__("detector")
        self.network = None
        self.publisher = self.create_publisher(Int32, "detected", 10)

    def on_configure(self, state):
        self.network = {"weights": 3}
        self.images = self.create_subscription(Int32, "image", self.on_image, 10)
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state):
        self.network = None
        return TransitionCallbackReturn.SUCCESS

    def on_image(self, image):
        self.publisher.publish(Int32(data=image.data * self.network["weights"]))


class TidyDetector(Detector):
    """Looks whether it is still configured."""

    def on_image(self, image):
        if self.network is not None:
            super().on_image(image)


class Manager(Node):
    """Configures the detector, and cleans it up when it has seen three results."""

    def __init__(self):
        super().__init__("manager")
        self.client = self.create_client(ChangeState, "detector/change_state")
        self.create_subscription(Int32, "detected", self.on_detected, 10)
        self.timer = self.create_timer(0.05, self.configure)

    def change(self, number):
        request = ChangeState.Request(transition=Transition(id=number))
        return self.client.call_async(request)

    def configure(self):
        if self.client.service_is_ready():
            self.timer.cancel()
            self.change(Transition.TRANSITION_CONFIGURE)

    def on_detected(self, message):
        if message.data == 9:
            self.cleanup_timer = self.create_timer(0.1, self.clean_up)

    def clean_up(self):
        self.cleanup_timer.cancel()
        self.change(Transition.TRANSITION_CLEANUP).add_done_callback(self.done)

    def done(self, future):
        self.get_logger().info("cleaned up")


class Shutter(Camera):
    """Takes four images."""

    def tick(self):
        if self.number < 4:
            super().tick()
