"""What the viewer shows, as pure functions and frozen values; nothing here knows a terminal."""
