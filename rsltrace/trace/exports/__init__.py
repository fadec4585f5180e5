"""A trace in formats of other tools: Perfetto's tracks, a layout for Foxglove and Lichtblick."""
