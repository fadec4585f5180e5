"""The language of filters and searches: from a text to a condition, from a condition to events."""
