"""A program of the nodes that one class or function makes: ``spin_node.py module:name [JSON]``."""

import importlib
import json
import sys

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.utilities import remove_ros_args


def main() -> None:
    target, *words = remove_ros_args(sys.argv)[1:]
    rclpy.init()
    module, _, name = target.partition(":")
    made = getattr(importlib.import_module(module), name)(**json.loads(words[0] if words else "{}"))
    executor = SingleThreadedExecutor()
    for node in made if isinstance(made, list) else [made]:
        executor.add_node(node)
    executor.spin()


if __name__ == "__main__":
    main()
