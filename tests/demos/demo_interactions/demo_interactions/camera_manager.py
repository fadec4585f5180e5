"""Takes the camera through its life by service calls, and looks at its frames."""

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.node import Node
from std_msgs.msg import String

STEPS = ("CONFIGURE", "ACTIVATE", "ACTIVATE", "DEACTIVATE", "CLEANUP")


class CameraManager(Node):
    """A client of the camera's lifecycle services."""

    def __init__(self):
        super().__init__("camera_manager")
        self.change = self.create_client(ChangeState, "camera/change_state")
        self.state = self.create_client(GetState, "camera/get_state")
        self.frames = []
        self.create_subscription(String, "frames", lambda m: self.frames.append(m.data), 10)

    def call(self, client, request):
        """Ask and wait for the answer."""
        future = client.call_async(request)
        rclpy.spin_until_future_complete(self, future)
        return future.result()

    def step(self, name):
        """Ask for a transition; log what came of it."""
        number = getattr(Transition, f"TRANSITION_{name}")
        done = self.call(self.change, ChangeState.Request(transition=Transition(id=number)))
        state = self.call(self.state, GetState.Request()).current_state.label
        self.get_logger().info(f"{name.lower()}: {'done' if done.success else 'failed'}, {state}")
        return state


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = CameraManager()
    for client in (node.change, node.state):
        client.wait_for_service()
    for name in STEPS:
        if node.step(name) == "active":
            while len(node.frames) < 3:
                rclpy.spin_once(node, timeout_sec=1.0)
            node.get_logger().info(f"frames in order: {node.frames == sorted(node.frames)}")
    node.step("UNCONFIGURED_SHUTDOWN")
    node.destroy_node()
    rclpy.shutdown()
