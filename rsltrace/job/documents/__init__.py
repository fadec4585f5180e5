"""A job written down: as YAML, as JSON Schema, as reference."""
