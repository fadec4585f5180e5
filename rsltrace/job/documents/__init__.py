"""What is made from the models for readers and editors: JSON Schema, and `docs/jobs.md`."""
