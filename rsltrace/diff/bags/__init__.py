"""Two recordings, topic by topic."""
