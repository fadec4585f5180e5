"""Fields of message classes that nobody has written into a message."""

from __future__ import annotations

NO_FIELD = "structure_needs_at_least_one_member"
"""What rosidl puts into messages without fields."""
PLACEHOLDERS = frozenset((NO_FIELD, "__msgtype__"))
"""That, and where rosbags' classes keep the name of the type."""
