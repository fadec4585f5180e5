"""What a run makes deterministic: clocks, chance, order, the environment."""
