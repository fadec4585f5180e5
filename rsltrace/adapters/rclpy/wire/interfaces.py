"""Interfaces by name, and what a trace keeps about them: the whole public surface of this topic.

Nothing of ROS is imported before it is asked for.
"""

from rsltrace.adapters.rclpy.wire.interface_classes import (
    class_of,
    get_message_class,
    get_service_class,
    type_name,
)
from rsltrace.adapters.rclpy.wire.interface_schema import (
    message_type,
    schema_text,
    service_type,
    type_hash,
)

__all__ = [
    "class_of",
    "get_message_class",
    "get_service_class",
    "message_type",
    "schema_text",
    "service_type",
    "type_hash",
    "type_name",
]
