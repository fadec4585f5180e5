"""Threads look whether the dock is free, and take it if it is: two may find it free."""

import threading

from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger


class Dock(Node):
    """Sends robots that come back to the dock or to the yard, in a thread for each."""

    def __init__(self):
        super().__init__("dock")
        self.is_free = True
        self.docked = 0
        self.publisher = self.create_publisher(Int32, "docked", 10)
        self.create_service(Trigger, "come_back", self.on_request)

    def on_request(self, request, response):
        robots = [threading.Thread(target=self.admit) for _ in range(3)]
        for robot in robots:
            robot.start()
        for robot in robots:
            robot.join()
        self.publisher.publish(Int32(data=self.docked))
        response.success = True
        return response

    def admit(self):
        if self.is_free:
            self.is_free = False
            self.docked += 1


class LockedDock(Dock):
    """Looks and takes under a lock."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()

    def admit(self):
        with self.lock:
            super().admit()


class Yard(Node):
    """Calls all robots back."""

    def __init__(self):
        super().__init__("yard")
        self.client = self.create_client(Trigger, "come_back")
        self.timer = self.create_timer(0.1, self.call)

    def call(self):
        self.timer.cancel()
        self.client.call_async(Trigger.Request())
