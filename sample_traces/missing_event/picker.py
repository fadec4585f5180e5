"""An arm that picks parts: one answer of its gripper never comes.

``Gripper`` waits for its motor inside the service callback. When the motor stalls, the callback
never returns, so the service never answers: an event of the other run is missing.
"""

import os
import random
import time

from rclpy.node import Node
from std_msgs.msg import UInt32
from std_srvs.srv import Trigger


class Motor:
    """Stands for hardware: closes in 150 ms, and sometimes stalls for good.

    Without MOTOR_SEED it is different in every run, as the real one is; the samples are made with
    two seeds so that they can be made again.
    """

    def __init__(self):
        self.wear = random.Random(os.environ.get("MOTOR_SEED"))

    def close(self):
        stalls = self.wear.random() < 0.07
        time.sleep(86400.0 if stalls else 0.15)


class Gripper(Node):
    """Closes when asked to."""

    def __init__(self):
        super().__init__("gripper")
        self.motor = Motor()
        self.create_service(Trigger, "close", self.on_close)

    def on_close(self, request, response):
        self.motor.close()
        response.success = True
        response.message = "closed"
        return response


class Picker(Node):
    """Picks a part every half second; skips a turn while the gripper has not answered."""

    def __init__(self):
        super().__init__("picker")
        self.gripper = self.create_client(Trigger, "close")
        self.picked = self.create_publisher(UInt32, "picked", 10)
        self.count = 0
        self.waiting = False
        self.create_timer(0.5, self.pick)

    def pick(self):
        if self.waiting:
            self.get_logger().warning("the gripper has not answered yet")
            return
        self.waiting = True
        self.gripper.call_async(Trigger.Request()).add_done_callback(self.on_closed)

    def on_closed(self, future):
        self.waiting = False
        if future.result().success:
            self.count += 1
            self.picked.publish(UInt32(data=self.count))
