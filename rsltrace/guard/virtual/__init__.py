"""What a run makes deterministic: clocks, randomness, order, the environment."""
