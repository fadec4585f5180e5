"""A node asks two estimators at once, and a coarse answer replaces the fine one."""

from rclpy.node import Node
from std_msgs.msg import Float64
from test_msgs.srv import BasicTypes


class Estimator(Node):
    """Answers with its accuracy."""

    def __init__(self):
        super().__init__("estimator")
        self.error = self.declare_parameter("error", 0.0).value
        self.create_service(BasicTypes, "~/estimate", self.estimate)

    def estimate(self, request, response):
        response.float64_value = self.error
        return response


class Locator(Node):
    """Starts from the coarse estimate and improves it."""

    def __init__(self):
        super().__init__("locator")
        self.error = 1000.0
        self.coarse = self.create_client(BasicTypes, "coarse/estimate")
        self.fine = self.create_client(BasicTypes, "fine/estimate")
        self.publisher = self.create_publisher(Float64, "error", 10)
        self.timer = self.create_timer(0.3, self.locate)
        self.create_timer(0.5, lambda: self.publisher.publish(Float64(data=self.error)))

    def locate(self):
        self.timer.cancel()
        for client in (self.coarse, self.fine):
            client.call_async(BasicTypes.Request()).add_done_callback(self.on_estimate)

    def on_estimate(self, future):
        self.error = future.result().float64_value


class ImprovingLocator(Locator):
    """Keeps the better estimate."""

    def on_estimate(self, future):
        self.error = min(self.error, future.result().float64_value)
