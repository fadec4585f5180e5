"""A sensor's first measurement comes before the answer with its calibration."""

from rclpy.node import Node
from std_msgs.msg import Float64
from test_msgs.srv import BasicTypes


class Calibration(Node):
    """Knows the sensor's gain."""

    def __init__(self):
        super().__init__("calibration")
        self.create_service(BasicTypes, "gain", self.gain)

    def gain(self, request, response):
        response.float64_value = 2.0
        return response


class Sensor(Node):
    """Measures ten times per second."""

    def __init__(self):
        super().__init__("sensor")
        self.publisher = self.create_publisher(Float64, "raw", 10)
        self.create_timer(0.1, lambda: self.publisher.publish(Float64(data=1.5)))


class Driver(Node):
    """Publishes calibrated measurements."""

    def __init__(self):
        super().__init__("driver")
        self.publisher = self.create_publisher(Float64, "measured", 10)
        self.create_subscription(Float64, "raw", self.on_raw, 10)
        self.client = self.create_client(BasicTypes, "gain")
        self.timer = self.create_timer(0.02, self.ask)

    def ask(self):
        if self.client.service_is_ready():
            self.timer.cancel()
            self.client.call_async(BasicTypes.Request()).add_done_callback(self.on_gain)

    def on_gain(self, future):
        self.gain = future.result().float64_value

    def on_raw(self, raw):
        self.publisher.publish(Float64(data=self.gain * raw.data))


class CalibratedDriver(Driver):
    """Drops what it cannot calibrate."""

    gain = None

    def on_raw(self, raw):
        if self.gain is not None:
            super().on_raw(raw)
