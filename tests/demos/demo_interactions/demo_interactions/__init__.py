"""Services, actions and lifecycle nodes, as ordinary programs."""
