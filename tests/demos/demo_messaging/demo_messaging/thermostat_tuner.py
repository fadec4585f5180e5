"""Reads and sets another node's parameters, and watches the parameter events."""

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.parameter_event_handler import ParameterEventHandler
from std_msgs.msg import Float64


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    node = Node("thermostat_tuner")
    log = node.get_logger()
    try:
        client = AsyncParameterClient(node, "thermostat")
        handler = ParameterEventHandler(node)
        events = []
        handler.add_parameter_callback("target", "/thermostat", lambda p: events.append(p))
        setpoints = []
        node.create_subscription(Float64, "setpoint", lambda m: setpoints.append(m.data), 10)
        if not client.wait_for_services(timeout_sec=300.0):
            raise RuntimeError("there is no thermostat")
        while not (node.count_publishers("/setpoint") and events_arrive(node)):
            rclpy.spin_once(node, timeout_sec=0.05)

        def answer(future):
            rclpy.spin_until_future_complete(node, future)
            return future.result()

        names = answer(client.list_parameters()).result.names
        log.info(f"parameters: {', '.join(sorted(set(names) - {'use_sim_time'}))}")
        values = answer(client.get_parameters(["target", "mode"])).values
        log.info(f"target {values[0].double_value}, mode {values[1].string_value}")
        described = answer(client.describe_parameters(["target"])).descriptors[0]
        limits = described.floating_point_range[0]
        log.info(f"from {limits.from_value} to {limits.to_value}")
        for name, value in (("target", 21.5), ("target", 99.0), ("mode", "party"), ("mode", "eco")):
            result = answer(client.set_parameters([Parameter(name, value=value)])).results[0]
            log.info(f"{name}={value}: {'set' if result.successful else result.reason}")
        while not (setpoints and events):
            rclpy.spin_once(node, timeout_sec=0.05)
        log.info(f"heard of {setpoints}, events {[e.value.double_value for e in events]}")
    finally:
        node.destroy_node()
        rclpy.shutdown()


def events_arrive(node):
    """Return whether the thermostat's parameter events will reach this node."""
    publishers = node.get_publishers_info_by_topic("/parameter_events")
    return "thermostat" in [each.node_name for each in publishers]
