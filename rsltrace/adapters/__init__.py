"""Who speaks for the nodes of a run: rclpy nodes in this process, recordings, drivers."""
