"""The object that stands where rclpy keeps its C extension, and how it gets there."""

loads_extension = True
"""Whether the C extension is loaded if it is there: other code in this process may need it. The
command has its process for itself, and needs it for native runs only."""
