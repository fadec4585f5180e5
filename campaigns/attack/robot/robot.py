"""A small healthy robot: timers, topics, a service, parameters, logs."""

from rclpy.node import Node
from std_msgs.msg import String, UInt64
from std_srvs.srv import Trigger


class Driver(Node):
    """Counts, and now and then asks the arm."""

    def __init__(self):
        super().__init__("driver")
        self.period = self.declare_parameter("period", 0.01).value
        self.count = 0
        self.ticks = self.create_publisher(UInt64, "ticks", 10)
        self.arm = self.create_client(Trigger, "grip")
        self.create_timer(self.period, self.tick)

    def tick(self):
        self.count += 1
        self.ticks.publish(UInt64(data=self.count))
        if self.count % 7 == 0:
            self.arm.call_async(Trigger.Request())
        if self.count % 20 == 0:
            self.get_logger().info(f"tick {self.count}")


class Arm(Node):
    """Answers, and says what it hears."""

    def __init__(self):
        super().__init__("arm")
        self.said = self.create_publisher(String, "said", 10)
        self.create_subscription(UInt64, "ticks", self.on_tick, 10)
        self.create_service(Trigger, "grip", self.on_grip)

    def on_tick(self, message):
        if message.data % 3 == 0:
            self.said.publish(String(data=f"heard {message.data} " + "x" * (message.data % 50)))

    def on_grip(self, request, response):
        response.success = True
        response.message = "closed"
        return response
