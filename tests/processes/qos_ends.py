"""One end of the pairs of ``tests/middleware/qos_matrix.py``, for test_qos_of_processes.py: its
arguments are which end, and where to write what it went through."""

import json
import sys
from pathlib import Path

import rclpy

sys.path.insert(0, str(Path(__file__).parents[1] / "middleware"))
import qos_matrix


def main() -> None:
    end, target = sys.argv[1:3]
    rclpy.init()
    node = {"offers": qos_matrix.Offers, "asks": qos_matrix.Asks}[end](1, 60)
    executor = rclpy.executors.SingleThreadedExecutor()
    if len(sys.argv) > 3 and sys.argv[3] == "events":
        from rclpy.experimental import EventsExecutor

        executor = EventsExecutor()
    executor.add_node(node)
    while not node.done:
        executor.spin_once(timeout_sec=0.1)
    Path(target).write_text(json.dumps(node.outcomes))
    rclpy.spin(node)


if __name__ == "__main__":
    main()
