"""Two limits are changed one after the other, and the controller uses one old and one new."""

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_msgs.msg import Float64


class Controller(Node):
    """Publishes the middle of its limits, which are never the wrong way round."""

    def __init__(self):
        super().__init__("controller")
        self.declare_parameter("lowest", 0.0)
        self.declare_parameter("highest", 1.0)
        self.publisher = self.create_publisher(Float64, "span", 10)
        self.create_timer(0.1, self.tick)

    def tick(self):
        low = self.get_parameter("lowest").value
        high = self.get_parameter("highest").value
        self.publisher.publish(Float64(data=high - low))


class Tuner(Node):
    """Moves the limits up by two."""

    def __init__(self):
        super().__init__("tuner")
        self.client = AsyncParameterClient(self, "controller")
        self.timer = self.create_timer(0.3, self.tune)

    def parameters(self):
        self.timer.cancel()
        return [
            Parameter("lowest", Parameter.Type.DOUBLE, 2.0),
            Parameter("highest", Parameter.Type.DOUBLE, 3.0),
        ]

    def tune(self):
        for parameter in self.parameters():
            self.client.set_parameters([parameter])


class AtomicTuner(Tuner):
    """Changes both at once."""

    def tune(self):
        self.client.set_parameters_atomically(self.parameters())
