"""Two traces: their first difference, and which event of one is which of the other after it."""
