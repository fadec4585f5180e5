"""What a diff says: frozen values that the comparisons fill and the reports print."""
