"""A managed node: it publishes only while it is active, and its first activation fails."""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from std_msgs.msg import String


class Camera(LifecycleNode):
    """Publishes /frames while active."""

    def __init__(self):
        super().__init__("camera")
        self.attempts = 0

    def on_configure(self, state):
        """Open the publisher."""
        self.get_logger().info(f"configuring from {state.label}")
        self.publisher = self.create_lifecycle_publisher(String, "frames", 10)
        self.timer = self.create_timer(0.05, self.shoot)
        self.count = 0
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state):
        """Fail once."""
        self.attempts += 1
        self.get_logger().info(f"activation {self.attempts}")
        if self.attempts == 1:
            return TransitionCallbackReturn.FAILURE
        return super().on_activate(state)

    def on_deactivate(self, state):
        """Stop."""
        self.get_logger().info("deactivating")
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        """Let go of everything."""
        self.destroy_timer(self.timer)
        self.destroy_publisher(self.publisher)
        self.get_logger().info(f"cleaned up from {state.label}")
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state):
        """Say goodbye."""
        self.get_logger().info(f"shut down from {state.label}")
        return TransitionCallbackReturn.SUCCESS

    def shoot(self):
        """Publish a frame, which goes nowhere while inactive."""
        if self.publisher.is_activated:
            self.count += 1
        self.publisher.publish(String(data=f"frame {self.count}"))


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = Camera()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
