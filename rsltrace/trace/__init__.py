"""The trace: its format, reader and writer, bags, and the words for its events."""
