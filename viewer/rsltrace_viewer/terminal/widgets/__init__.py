"""What the main screen consists of."""
