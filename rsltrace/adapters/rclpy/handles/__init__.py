"""What rclpy gets in place of C objects: handles of nodes, endpoints, timers, clocks, wait sets."""
