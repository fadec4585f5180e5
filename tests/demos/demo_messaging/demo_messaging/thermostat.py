"""A node whose parameters can be set, within limits; it publishes what it is set to."""

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Float64


class Thermostat(Node):
    """Publishes /setpoint whenever its parameter ``target`` changes."""

    def __init__(self):
        super().__init__("thermostat")
        self.publisher = self.create_publisher(Float64, "setpoint", 10)
        limits = FloatingPointRange(from_value=5.0, to_value=30.0)
        self.declare_parameter("target", 20.0, ParameterDescriptor(floating_point_range=[limits]))
        self.declare_parameter("mode", "auto")
        self.add_on_set_parameters_callback(self.check)
        self.add_post_set_parameters_callback(self.changed)

    def check(self, parameters):
        """Refuse modes that do not exist."""
        for parameter in parameters:
            if parameter.name == "mode" and parameter.value not in ("auto", "eco"):
                return SetParametersResult(successful=False, reason=f"no mode {parameter.value}")
        return SetParametersResult(successful=True)

    def changed(self, parameters):
        """Tell everybody."""
        for parameter in parameters:
            self.get_logger().info(f"{parameter.name} is {parameter.value} now")
            if parameter.name == "target":
                self.publisher.publish(Float64(data=parameter.value))


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = Thermostat()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.shutdown()
        node.destroy_node()
