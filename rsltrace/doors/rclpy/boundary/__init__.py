"""The object that stands where rclpy keeps its C extension, and the handles it gives out."""
