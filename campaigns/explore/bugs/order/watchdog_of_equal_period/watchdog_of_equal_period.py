"""A watchdog counts heartbeats since it last looked, and looks as often as they come."""

from rclpy.node import Node
from std_msgs.msg import Bool, Empty


class Driver(Node):
    """Says ten times per second that it is alive."""

    def __init__(self):
        super().__init__("driver")
        self.publisher = self.create_publisher(Empty, "heartbeat", 10)
        self.create_timer(0.1, lambda: self.publisher.publish(Empty()))


class Watchdog(Node):
    """Stops the robot when there was no heartbeat since the last look."""

    def __init__(self):
        super().__init__("watchdog")
        self.beats = 0
        self.publisher = self.create_publisher(Bool, "emergency_stop", 10)
        self.create_subscription(Empty, "heartbeat", self.on_heartbeat, 10)
        self.create_timer(0.1, self.look)

    def on_heartbeat(self, message):
        self.beats += 1

    def look(self):
        self.publisher.publish(Bool(data=self.beats == 0))
        self.beats = 0


class LenientWatchdog(Watchdog):
    """Waits for two and a half periods."""

    last = None

    def on_heartbeat(self, message):
        self.last = self.get_clock().now()

    def look(self):
        now = self.get_clock().now()
        silent = self.last is not None and (now - self.last).nanoseconds > 250_000_000
        self.publisher.publish(Bool(data=silent))
