"""Interfaces by name, and what a trace keeps about them: the whole public surface of this topic.

Nothing of ROS is imported before it is asked for.
"""

from rsltrace.doors.rclpy.wire.interface_classes import (
    get_message_class,
    get_service_class,
    type_name,
)
from rsltrace.doors.rclpy.wire.interface_schema import schema_text, type_hash

__all__ = ["get_message_class", "get_service_class", "schema_text", "type_hash", "type_name"]
