"""What commands print and write: lines, JSON, whole files, and the exit status."""
