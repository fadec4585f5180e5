"""Which tests of rclcpp go another way in a simulation, and why: ``docs/qualification/index.md``."""

KNOWN: dict[str, str] = {}
"""By ``executable test``, as a pattern of the shell."""
