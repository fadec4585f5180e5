"""Two decoded messages, field by field."""
