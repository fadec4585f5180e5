"""The discrete-event loop: pure, in integer nanoseconds, without rclpy or files."""
