"""Waits for the nodes it is told of and writes down who offers what."""

import sys

import rclpy
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

BORING = {"/rosout", "/parameter_events"}


class Census(Node):
    """Looks at the graph, twice a second, until it is complete and has stayed the same."""

    def __init__(self, expected):
        super().__init__("census")
        self.expected = set(expected)
        self.last = None

    def present(self):
        """Return whether everybody is there."""
        return self.expected <= set(self.get_node_names())

    def look(self):
        """Return topics, services and nodes as text."""
        topics = {n: t for n, t in self.get_topic_names_and_types() if n not in BORING}
        lines = [f"topic {name} {' '.join(types)}" for name, types in sorted(topics.items())]
        for name in sorted(self.expected):
            services = sorted(self.get_service_names_and_types_by_node(name, "/"))
            lines += [f"{name} serves {service} {' '.join(t)}" for service, t in services]
            ends = self.get_publisher_names_and_types_by_node(name, "/")
            lines += [f"{name} publishes {t}" for t, _ in sorted(ends) if t not in BORING]
        return lines


def main(args=None):
    """Run the program."""
    rclpy.init(args=args)
    words = remove_ros_args(sys.argv if args is None else args)[1:]
    node = Census(words)
    same = 0
    while same < 8:
        rclpy.spin_once(node, timeout_sec=0.5)
        seen = node.look() if node.present() else None
        same = same + 1 if seen is not None and seen == node.last else 0
        node.last = seen
    for line in node.last:
        node.get_logger().info(line)
    node.destroy_node()
    rclpy.shutdown()
