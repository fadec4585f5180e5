"""From job files to models, with file, line and column for every mistake."""
