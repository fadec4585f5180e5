"""rclpy's executors on simulated time: the run's own, and those that users make."""
