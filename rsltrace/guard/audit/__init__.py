"""The audit: what in the sources of nodes could make runs differ."""
