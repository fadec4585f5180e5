"""The comparison of two traces: alignment and causes put together into one ``Diff``."""
