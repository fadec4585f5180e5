"""Topics and parameters, as ordinary programs."""
