"""The object that stands where rclpy keeps its C extension, and how it gets there."""
