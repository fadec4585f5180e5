"""A node's state as a number, and as text."""
